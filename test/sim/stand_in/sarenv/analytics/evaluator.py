"""Stands in for SAREnv where that is not installed: what of its evaluator the judge calls."""

import json
import random
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import shapely
import shapely.ops
from shapely import LineString

__all__ = ['ComparativeEvaluator', 'LineString', 'PathGenerator', 'paths']
# As imports of the real one do.
random.random()
DEGREE = 0.9996 * np.array([111319.49, 110574.3])  # metres of a degree on the equator, in UTM


class Victims:
    def __init__(self, points):
        self.geometry = SimpleNamespace(x=np.array(points)[:, 0], y=np.array(points)[:, 1])

    def __len__(self):
        return len(self.geometry.x)


class PathGenerator:
    def __init__(self, name, func, path_generator_config):
        self.name, self.func, self.config = name, func, path_generator_config

    def __call__(self, center_x, center_y, max_radius, probability_map, bounds):
        return self.func(
            center_x=center_x,
            center_y=center_y,
            max_radius=max_radius,
            probability_map=probability_map,
            bounds=bounds,
            num_drones=self.config.num_drones,
            budget=self.config.budget,
            fov_deg=self.config.fov_degrees,
            altitude=self.config.altitude_meters,
        )


def split_path_for_drones(path, num_drones):
    part = path.length / num_drones
    return [shapely.ops.substring(path, i * part, (i + 1) * part) for i in range(num_drones)]


paths = SimpleNamespace(split_path_for_drones=split_path_for_drones)


def spiral(center_x, center_y, budget, num_drones, **_):
    """Return a spiral of the whole budget, 66 m between its turns, cut into equal parts."""
    angle = np.linspace(0.0, np.sqrt(2.0 * budget * 2.0 * np.pi / 66.0), 4000)
    radius = 66.0 * angle / (2.0 * np.pi)
    turns = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    way = LineString(turns + np.array([center_x, center_y]))
    return split_path_for_drones(shapely.ops.substring(way, 0.0, budget), num_drones)


class ComparativeEvaluator:
    def __init__(self, dataset_directory, evaluation_sizes, num_drones, num_lost_persons):
        folder = Path(dataset_directory)
        facts = json.loads((folder / 'features.geojson').read_text())
        middle = np.reshape(facts['bounds'], (2, 2)).mean(axis=0)
        points = []
        while len(points) < num_lost_persons:
            feature = random.choices(
                facts['features'],
                [feature['properties']['area_probability'] for feature in facts['features']],
            )[0]
            corners = np.subtract(feature['geometry']['coordinates'][0], facts['center_point'])
            low, high = (corners * DEGREE).min(axis=0), (corners * DEGREE).max(axis=0)
            points.append(middle + [random.uniform(*pair) for pair in zip(low, high)])
        item = SimpleNamespace(
            heatmap=np.load(folder / 'heatmap.npy'),
            bounds=facts['bounds'],
            environment_type=facts['environment_type'],
            environment_climate=facts['climate'],
        )
        [size] = evaluation_sizes
        self.environments = {size: {'item': item, 'victims': Victims(points)}}
        self.path_generator_config = SimpleNamespace(
            num_drones=num_drones, budget=1e5, fov_degrees=45.0, altitude_meters=80.0
        )
        names = ('RandomWalk', 'Greedy', 'Spiral', 'Concentric', 'Pizza')
        self.path_generators = {
            name: PathGenerator(name, spiral, self.path_generator_config) for name in names
        }

    def run_baseline_evaluations(self):
        [environment] = self.environments.values()
        item, config = environment['item'], self.path_generator_config
        reach = config.altitude_meters * np.tan(np.radians(config.fov_degrees / 2.0))
        where = environment['victims'].geometry
        west, south, east, north = item.bounds
        table = {'Algorithm': [], 'Victims Found (%)': [], 'Total Path Length (km)': []}
        for name, generator in self.path_generators.items():
            ways = generator(
                (west + east) / 2.0,
                (south + north) / 2.0,
                (east - west) / 2.0,
                item.heatmap,
                item.bounds,
            )
            seen = shapely.union_all([way.buffer(reach) for way in ways])
            table['Algorithm'].append(name)
            table['Victims Found (%)'].append(
                100.0 * np.mean(shapely.contains_xy(seen, where.x, where.y))
            )
            table['Total Path Length (km)'].append(sum(way.length for way in ways) / 1000.0)
        return table, {}

"""Areas, keep-outs and priors: how they are given, and where targets are expected."""

import json

import numpy as np
import pytest
import shapely
from PIL import Image
from pydantic import ValidationError

from maasi_filter import BoxDetection, Pose, UnexploredMap
from maasi_filter.area import Area
from maasi_filter.environment import EnvironmentSettings
from maasi_filter.geodesy import OriginSettings, geodetic
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import flatten, unflatten

RING = [[0.0, 0.0], [40.0, 0.0], [40.0, 30.0], [10.0, 30.0]]
HOLE = [[20.0, 10.0], [26.0, 10.0], [26.0, 16.0], [20.0, 16.0]]
SQUARE = [[30.0, 20.0], [36.0, 20.0], [36.0, 26.0], [30.0, 26.0]]
ORIGIN = OriginSettings(latitude=46.6, longitude=9.9, altitude=1800.0)


def environment(**values):
    return EnvironmentSettings.model_validate(values)


def degrees(ring):
    """Return a closed ring as GeoJSON has it."""
    places = geodetic(np.array([*ring, ring[0]]), ORIGIN)
    return places[:, [1, 0]].tolist()


def feature(*rings, **properties):
    shape = {'type': 'Polygon', 'coordinates': [degrees(ring) for ring in rings]}
    return {'type': 'Feature', 'properties': properties, 'geometry': shape}


def test_the_forms_of_an_area_are_the_same_area(tmp_path):
    collection = {
        'type': 'FeatureCollection',
        'features': [
            feature(RING, HOLE),
            feature(SQUARE, role='keep_out'),
            feature(HOLE, role='prior', weight=3.0),
        ],
    }
    file = tmp_path / 'field.geojson'
    file.write_text(json.dumps(collection))
    rings = environment(area=[RING, HOLE], keep_outs=[SQUARE])
    text = environment(area=rings.area, keep_outs=[rings.keep_outs[0].polygon])
    of_file = environment(area=str(file), origin=ORIGIN)
    assert text == rings and rings.dimension == 2 and rings.bounds == [[0.0, 40.0], [0.0, 30.0]]
    for made in (rings, text, of_file):
        region = Area(made).region
        assert region.area == pytest.approx(1050.0 - 36.0 - 36.0, rel=1e-6)
        assert region.symmetric_difference(Area(rings).region).area < 0.1
    assert of_file.prior.polygons[0].weight == 3.0
    amid = environment(area=str(file)).origin
    assert amid.latitude == pytest.approx(46.6, abs=1e-3)
    # As it is drawn on the page of a run: where its map is, or in metres.
    drawn = environment(area=feature(RING, HOLE, origin=ORIGIN.model_dump()))
    shape = {'type': 'Polygon', 'coordinates': [[*ring, ring[0]] for ring in (RING, HOLE)]}
    metres = {'type': 'Feature', 'properties': {'unit': 'm'}, 'geometry': shape}
    metres = environment(area=metres)
    assert drawn.origin == ORIGIN and metres.origin is None
    whole = Area(environment(area=[RING, HOLE])).region
    for made in (drawn, metres):
        assert Area(made).region.symmetric_difference(whole).area < 0.1
    solid = environment(area=[RING, HOLE], altitude=[0.0, 20.0])
    assert solid.dimension == 3 and Area(solid).volume == pytest.approx(20280.0, rel=0.01)


def test_an_environment_survives_the_parameters_of_a_node():
    prior = {'polygons': [{'polygon': HOLE, 'weight': 2.0}], 'floor': 0.1}
    zones = [SQUARE, {'centre': [5.0, 6.0], 'radius': 1.5}]
    given = environment(
        area=RING, keep_outs=zones, obstacles=zones, prior=prior, origin=ORIGIN, altitude=[0.0, 9.0]
    )
    flat = {f'environment.{key}': value for key, value in flatten(given).items()}
    nested = unflatten(FilterNodeSettings, {**flat, 'robots': []})['environment']
    assert EnvironmentSettings.model_validate(nested) == given
    assert flat['environment.keep_outs'][1] == '5.0 6.0 1.5'


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({'area': [[0, 0], [1, 1], [1, 0], [0, 1]]}, 'area: .*Self-intersection'),
        ({'area': [[0, 0], [1, 1]]}, 'area: '),
        ({'area': 'nowhere.geojson'}, 'area: .*nowhere.geojson'),
        ({'area': RING, 'keep_outs': [feature(SQUARE)]}, r'keep_outs\[0\]: .*origin'),
        ({'area': RING, 'keep_outs': ['circle']}, r'keep_outs\[0\]: got circle, allowed'),
        ({'area': RING, 'keep_outs': [{'centre': [1, 2]}]}, 'centre and radius, or polygon'),
        ({'area': RING, 'keep_outs': [{'centre': [1, 2, 3], 'radius': 1}]}, 'allowed are 2 coord'),
        ({'area': feature(RING, role='garden')}, 'got role garden, allowed are area'),
        ({'bounds': [[0, 1], [0, 1]], 'altitude': [0, 1]}, 'altitude: allowed with area'),
        ({'bounds': [[0, 1], [1, 1]]}, r'axis 1: got \[1.0, 1.0\]'),
    ],
)
def test_wrong_environments_are_refused_by_their_key(values, words):
    with pytest.raises(ValidationError, match=words):
        environment(**values)


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({'keep_outs': [[[-1, -1], [50, -1], [50, 50], [-1, 50]]]}, 'nothing of the area is left'),
        ({'prior': {'raster': 'none.npy'}}, 'prior.raster: none.npy'),
        ({'prior': {'polygons': [{'polygon': RING, 'weight': 0.0}]}}, 'promises nothing'),
    ],
)
def test_areas_that_cannot_be_used_are_refused(values, words):
    with pytest.raises(ValueError, match=words):
        Area(environment(area=RING, **values))


def test_a_map_of_nav2_is_obstacles(tmp_path):
    """Walls and a pillar; unknown cells (205) are free."""
    cells = np.full((40, 60), 254, np.uint8)
    cells[0], cells[-1], cells[:, 0], cells[:, -1] = 0, 0, 0, 0
    cells[10:14, 20:24], cells[30:, 40:50] = 0, 205
    Image.fromarray(cells).save(tmp_path / 'room.pgm')
    file = tmp_path / 'room.yaml'
    facts = {'image': 'room.pgm', 'resolution': 0.05, 'origin': [-1.0, -0.5, 0.0], 'negate': 0}
    file.write_text(json.dumps({**facts, 'occupied_thresh': 0.65, 'free_thresh': 0.25}))
    area = Area(environment(bounds=[[-1.0, 2.0], [-0.5, 1.5]], obstacles=[str(file)]))
    places = np.random.default_rng(901).uniform([-1.0, -0.5, 0.0], [2.0, 1.5, 0.0], (2000, 3))
    columns = ((places[:, 0] + 1.0) / 0.05).astype(int)
    rows = 39 - ((places[:, 1] + 0.5) / 0.05).astype(int)
    gaps = np.array([area.distances(place).min() for place in places])
    assert (gaps[cells[rows, columns] == 0] == 0.0).all()
    # A pillar of 0.2 m around (0.1, 0.9), and half a cell more.
    assert area.distances([0.5, 0.9, 0.0]).min() == pytest.approx(0.3 - 0.025, abs=1e-6)
    assert area.distances([1.3, 0.0, 0.0]).min() > 0.3
    with pytest.raises(ValidationError, match=r'obstacles\[0\]: .*no map of Nav2'):
        environment(bounds=[[-1.0, 2.0], [-0.5, 1.5]], obstacles=['none.yaml'])


def test_the_density_is_prior_times_inside_with_mean_one(tmp_path):
    raster = np.zeros((30, 40))
    raster[:15, 20:] = 4.0  # North east.
    file = tmp_path / 'prior.npy'
    np.save(file, raster)
    area = Area(environment(area=[RING, HOLE], keep_outs=[SQUARE], prior=str(file)))
    rng = np.random.default_rng(900)
    places = rng.uniform([0.0, 0.0], [40.0, 30.0], (200_000, 2))
    density, inside = area.density(places), area.inside(places)
    # Cells of the raster are 8 cm wide, so that places near the border may be of either.
    border = area.region.boundary.buffer(0.1)
    sure = ~shapely.contains_xy(border, places[:, 0], places[:, 1])
    assert ((density > 0.0) == inside)[sure].all()
    assert density[inside].mean() == pytest.approx(1.0, rel=0.02)
    promised = inside & (places[:, 0] > 20.1) & (places[:, 1] > 15.1)
    poor = inside & ((places[:, 0] < 19.9) | (places[:, 1] < 14.9))
    assert density[poor].max() == pytest.approx(0.02)
    assert np.ptp(density[promised & sure]) == 0.0
    drawn = [area.draw(rng, *area.bounds.T, by_prior=True) for _ in range(4000)]
    drawn = np.array([place for place in drawn if place is not None])
    east = (drawn[:, 0] > 20.0) & (drawn[:, 1] > 15.0)
    expected = 0.98 + 0.02 * promised.sum() / inside.sum()
    # Four deviations of a share.
    assert east.mean() == pytest.approx(expected, abs=4.0 * 0.14 / np.sqrt(len(drawn)))


def test_the_map_counts_what_is_expected_only():
    """A look at a quarter of the area with most of the prior explores most of it."""
    quarter = [[0.0, 0.0], [20.0, 0.0], [20.0, 20.0], [0.0, 20.0]]
    prior = {'polygons': [{'polygon': quarter, 'weight': 27.0}], 'floor': 0.0}
    area = Area(environment(bounds=[[0.0, 40.0], [0.0, 40.0]], prior=prior))
    explored = UnexploredMap(area, 1.0)
    assert explored.cell_volumes().sum() == pytest.approx(1600.0, rel=0.02)
    explored.update(BoxDetection([-10.0, -10.0], [10.0, 10.0], 1.0), Pose(np.array([10.0, 10.0])))
    assert explored.explored_fraction() == pytest.approx(0.9, abs=0.03)
    assert explored.expected()[-1, -1] == pytest.approx(1.0 / 27.0)
    uniform = UnexploredMap([[0.0, 40.0], [0.0, 40.0]], 1.0)
    assert (uniform.expected() == uniform.values).all()
    explored.take_area(uniform.area)
    assert (explored.cell_volumes() == uniform.cell_volumes()).all()

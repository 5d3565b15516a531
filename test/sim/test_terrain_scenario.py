"""Searches over terrain: what a scenario is refused for, and heights of robots and targets."""

import json
from copy import deepcopy

import numpy as np
import pytest

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.geodesy import OriginSettings
from maasi_sim.run.targets.exports import plan_text
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.scenario.loading import load_scenario, scenario_from_values
from maasi_sim.scenario.preflight import preflight
from maasi_sim.search import search
from maasi_sim.simulation.robots import Simulation

MAVLINK = {'arm': True, 'url': 'udpin:127.0.0.1:14577'}


@pytest.mark.parametrize(
    ('changes', 'text'),
    [
        ({'link': 'mavlink', 'mavlink': MAVLINK}, r'west\.link: read mavlink with environment'),
        ({'start': [-240.0, -180.0, 2.0]}, r'west\.start: read height 2, .* at least 2\.5 m above'),
    ],
)
def test_what_robots_cannot_do_over_terrain_is_refused_by_name(changes, text):
    values = deepcopy(load_scenario('hills').content())
    values['robots']['west'] |= changes
    with pytest.raises(ScenarioError, match=text):
        scenario_from_values(values, 'test')
    other = deepcopy(load_scenario('hills').content())
    other['filter'] = {'method': 'ic_phd'}
    with pytest.raises(ScenarioError, match=r"filter\.method: read 'ic_phd' with environment"):
        scenario_from_values(other, 'test')


def test_robots_and_targets_are_at_heights_above_the_ground():
    simulation = Simulation(load_scenario('hills'), 1)
    terrain = simulation.world.area.terrain
    targets = simulation.world.targets_3d_at(0)
    assert targets[:, 2] == pytest.approx(terrain.heights(targets))
    assert np.ptp(targets[:, 2]) > 5.0
    heights = {'east': 30.0, 'west': 30.0, 'rover': 1.5}
    for _ in range(50):
        simulation.robots['rover'].command([2.0, 0.0, 0.0, 0.1])
        simulation.advance()
    for name, robot in simulation.robots.items():
        position = robot.state.pose.position
        assert position[2] - terrain.height(position) == pytest.approx(heights[name], abs=1e-6)
    moved = simulation.robots['rover'].state.pose.position
    assert np.linalg.norm(moved[:2]) > 5.0
    assert abs(moved[2] - 1.5 - terrain.height([0.0, 0.0])) > 0.5


@pytest.mark.parametrize('seed', range(5))
def test_the_estimate_describes_the_terrain(tmp_path, seed):
    generator = np.random.default_rng(seed)
    step, low = float(generator.integers(4, 40)), float(generator.integers(-300, 300))
    columns, rows = (int(560.0 / step) + generator.integers(3, 9, 2)).tolist()
    heights = low + generator.uniform(1.0, 90.0, (rows, columns))
    heights[0, 0], heights[-1, -1] = low, low + 100.0
    west = -0.5 * step * (columns - 1)
    south = -0.5 * step * (rows - 1)
    head = f'ncols {columns}\nnrows {rows}\nxllcenter {west}\nyllcenter {south}\ncellsize {step}\n'
    body = '\n'.join(' '.join(map(str, row)) for row in heights)
    (tmp_path / 'ground.asc').write_text(head + body)
    values = deepcopy(load_scenario('hills').content())
    values['environment']['terrain'] = str(tmp_path / 'ground.asc')
    (line,) = (
        line
        for line in preflight(scenario_from_values(values, 'test')).lines
        if line.startswith('terrain: ')
    )
    assert line == (
        f'terrain: ground.asc, {step * columns:.3g} m x {step * rows:.3g} m, '
        f'heights {low:g} to {low + 100.0:g} m above z = 0, cells of {step:g} m'
    )
    del values['environment']['terrain']
    flat = preflight(scenario_from_values(values, 'test')).lines
    assert not any('terrain' in line for line in flat)


def test_records_and_plans_have_heights_of_the_map():
    """The planner's heights are above ground, those of a plan file from the start."""
    values = deepcopy(load_scenario('hills').content())
    origin = OriginSettings(latitude=46.6, longitude=9.9)
    values['environment']['origin'] = origin.model_dump()
    values['limits'] = {'time': 60.0}
    log = search(scenario_from_values(values, 'test'), 1)
    terrain = Area(log.scenario.environment).terrain
    paths = log.planned_paths()
    for name, height in {'east': 30.0, 'west': 30.0, 'rover': 1.5}.items():
        path = paths[name]
        assert len(path) >= 2
        above = path[:, 2] - terrain.heights(path)
        # The first one is a measured position.
        assert above[1:] == pytest.approx(height, abs=1e-6) and abs(above[0] - height) < 0.5
    for decision in log.decisions:
        for chosen in decision.robots.values():
            positions = np.vstack([chosen.waypoint, chosen.positions, chosen.tour])
            assert (positions[:, 2] > terrain.heights(positions)).all()
    plan = json.loads(plan_text(paths['west'], [], origin))
    heights = [item['Altitude'] for item in plan['mission']['items']]
    assert heights == pytest.approx((paths['west'][1:, 2] - paths['west'][0, 2]).tolist(), abs=0.1)

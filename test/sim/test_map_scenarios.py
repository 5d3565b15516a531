"""A ground robot searches maps as mapping runs leave them, and ends with all in reach explored."""

import warnings

import numpy as np
import pytest
from made_maps import hall, pillar_room
from map_scenarios import Watched, hall_scenario, room_scenario

from maasi_filter.geometry.occupancy_map import read_map
from maasi_sim.scenario.layering import ScenarioWarning
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.search import _Search


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ('make_map', 'make_scenario'), [(pillar_room, room_scenario), (hall, hall_scenario)]
)
def test_a_ground_robot_finishes_a_search_of_a_map(make_map, make_scenario, tmp_path):
    map_file = make_map(tmp_path, 1)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', ScenarioWarning)
        scenario = scenario_from_values(make_scenario(map_file), 'test')
    running = _Search(scenario, 1, None)
    watched = Watched(running)
    result = running.run(None)
    assert result.end_reason == 'planner_done', running.world.targets
    assert result.scores.complete and len(result.found_targets) == len(result.truth)
    assert watched.nearest('rover', map_file) >= scenario.robots['rover'].radius


def test_made_maps_are_as_real_ones_and_the_same_for_the_same_seed(tmp_path):
    (tmp_path / 'again').mkdir()
    for make_map, least in ((pillar_room, 300), (hall, 3000)):
        one, again = make_map(tmp_path, 3), make_map(tmp_path / 'again', 3)
        assert one.with_suffix('.pgm').read_bytes() == again.with_suffix('.pgm').read_bytes()
        outline = read_map(str(one))
        assert len(np.concatenate([np.asarray(p.exterior.coords) for p in outline.geoms])) > least

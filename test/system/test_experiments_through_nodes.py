"""An experiment of the papers through the nodes: the same decisions as in one process."""

import pytest
import yaml
from scenario_runs import plain, run_scenario

from maasi_sim.experiments.papers import find
from maasi_sim.run.bag import Bag
from maasi_sim.scenario.loading import scenario_from_content
from maasi_sim.search import search

pytestmark = pytest.mark.system


def test_an_experiment_decides_through_the_nodes_as_in_one_process(tmp_path):
    experiment = find('000-fig11')
    case = next(case for case in experiment.cases(True) if case.name == 'MAASI')
    content = {**case.settings['scenario'], 'limits': {'time': 25.0}}
    seed = experiment.seed(0)
    file = tmp_path / 'experiment.yaml'
    file.write_text(yaml.safe_dump(content))
    run = run_scenario(file, tmp_path / 'run', '--seed', seed, '--lockstep')
    assert run.code in (0, 1), run.output
    result = search(scenario_from_content(content, 'experiment'), seed)

    with Bag(run.bag) as bag:
        decisions = [plain(item.message) for item in bag.messages(['/decisions'])]
    assert len(result.decisions) == len(decisions) > 2
    for ours, theirs in zip(result.decisions, decisions):
        assert ours.step == theirs['step']
        assert ours.robots.keys() == {robot['robot'] for robot in theirs['robots']}
        for robot in theirs['robots']:
            mine = ours.robots[robot['robot']]
            assert mine.waypoint.tolist() == [robot['waypoint'][axis] for axis in 'xyz']
    found = [target.position.tolist() for target in result.found_targets]
    assert found and found == [list(item['position']) for item in run.report['found']]
    assert result.measurements == run.report['measurements']
    assert result.truth.tolist() == run.report['targets']

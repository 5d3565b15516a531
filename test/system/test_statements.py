"""Statements of persons in whole runs: robots go elsewhere, equal runs stay equal."""

import pytest
from scenario_runs import alongside, check_replay, of_topic, start, write_scenario

from maasi_filter.ros.report_client import KINDS

pytestmark = pytest.mark.system

# Late enough that both statements have arrived before it.
STEP = 240
WEST = 'POLYGON ((-0.3 -0.3, 1.05 -0.3, 1.05 2.4, -0.3 2.4, -0.3 -0.3))'
SIGHTING = {'radius': 0.3, 'weight': 3.0, 'source': 'Ann'}


def state(operator, name, **fields):
    """Make a statement, and return the answer."""
    request = KINDS[name].Request(step=STEP)
    for field, value in fields.items():
        setattr(request, field, value)
    client = operator.node.create_client(KINDS[name], f'/search/{name}')
    operator.until(client.service_is_ready, name)
    answer = client.call_async(request)
    operator.until(answer.done, name)
    return answer.result()


def test_robots_go_where_a_person_saw_a_target_and_not_where_others_searched(tmp_path):
    # It starts in the west, where there is nothing else.
    file = write_scenario(tmp_path / 'search.yaml', [[2.2, 0.1]], start=(0.2, 2.2, 1.0))
    runs = []
    for name in ('one', 'two'):
        with alongside() as operator:
            options = ('--lockstep', '--rate', '4', *operator.options)
            with start(file, tmp_path / name, *options) as run:
                answer = state(
                    operator, 'mark_searched', zone=WEST, detection_probability=0.98, source='dogs'
                )
                assert answer.success and answer.message.endswith('waits for the next batch')
                request = KINDS['add_sighting'].Request()
                request.position.x, request.position.y = 2.1, 0.2
                assert state(
                    operator, 'add_sighting', position=request.position, **SIGHTING
                ).success
                run.finish()
        assert run.code == 0, run.output
        runs.append(run)
    for run in runs:
        reports = of_topic(run, '/reports')
        assert [item['id'] for item in reports] == [1, 2]
        updates = of_topic(run, '/filter_update')
        first = next(item['step'] for item in updates if item['reports'])
        assert STEP <= first <= STEP + 20
        later = [item for item in of_topic(run, '/decisions') if item['step'] > first]
        waypoints = [robot['waypoint'] for item in later for robot in item['robots']]
        assert len(waypoints) >= 2
        assert all(item['x'] > 0.9 for item in waypoints)
        # The target of the sighting is found.
        assert len(run.report['found']) == 1
        assert {event['agent'] for event in run.report['events']} == {'Ann', 'dogs'}
        assert 'sighting of Ann' in (run.folder / 'report.json').read_text()
    for topic in ('/filter_update', '/decisions', '/reports', '/found_targets'):
        assert of_topic(runs[0], topic) == of_topic(runs[1], topic)
    check_replay(runs[0], tmp_path)

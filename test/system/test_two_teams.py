"""Two teams in one ROS domain, each in its namespace, on one clock."""

import itertools

import pytest
from rosgraph_msgs.msg import Clock
from scenario_runs import beside, check_replay, start, write_scenario

from maasi_filter.ros.conversions import stamp_from_ros, stamp_to_ros
from maasi_sim.run.bag import Bag

pytestmark = pytest.mark.system
STEP = 0.05


@pytest.fixture(scope='module')
def teams(tmp_path_factory):
    """Return the runs of two teams, by namespace; the first one's clock is that of both."""
    folder = tmp_path_factory.mktemp('teams')
    first = write_scenario(folder / 'first.yaml', [[0.3, 0.4]])
    second = write_scenario(folder / 'second.yaml', [[0.6, 0.6]], (0.3, 0.3, 1.0))
    with beside() as operator:
        options = [*operator.options, '--namespace']
        with start(first, folder / 'team_a', *options, 'team_a') as leading:
            # A robot that does not take part yet is not paused.
            leading.wait_for('measurements')
            # It would find all before the second one measures.
            operator.call('/team_a/search/pause')
            options += ['team_b', '--follow-clock']
            with start(second, folder / 'team_b', *options) as following:
                following.wait_for('measurements')
                operator.call('/team_a/search/resume')
                return {'team_b': following.finish(), 'team_a': leading.finish()}


def test_both_teams_find_their_targets(teams):
    for run in teams.values():
        assert run.code == 0, run.output
        assert run.report['end_reason'] == 'all_found'
        assert (run.report['true_found'], run.report['false_found']) == (1, 0)
        assert 0.0 < run.report['time_to_find_all'] < 120.0


@pytest.mark.parametrize('team', ['team_a', 'team_b'])
def test_a_recording_holds_its_own_team_from_its_first_measurement_on(teams, team):
    with Bag(teams[team].bag) as bag:
        facts, counts = bag.scenario(), bag.counts
        names = {
            status.name for item in bag.messages(['/diagnostics']) for status in item.message.status
        }
        loggers = {item.message.name for item in bag.messages(['/rosout'])}
        batches = [item.message.id for item in bag.messages([f'/{team}/measurement_batch'])]
        asked = {item.message.batch_id for item in bag.messages([f'/{team}/mambo/detections'])}
        steps = [item.message for item in bag.messages([f'/{team}/lockstep/step'])]
        clock = [stamp_from_ros(item.message.clock) for item in bag.messages(['/clock'])]
    shared = {'/clock', '/diagnostics', '/rosout', '/scenario', '/ending'}
    assert {topic for topic in counts if not topic.startswith(f'/{team}/')} == shared
    assert names and all(name.startswith(f'/{team}/') for name in names)
    assert loggers and all(name.startswith(f'{team}.') for name in loggers)
    assert batches[0] == 1
    # One that is on its way as the run ends may be missing.
    assert set(batches[:-1]) <= asked <= set(batches)
    assert counts[f'/{team}/filter_update'] >= len(batches) - 1
    numbers = [step.step for step in steps]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert stamp_from_ros(steps[-1].stamp) <= clock[-1]
    follows = team == 'team_b'
    assert (facts['namespace'], facts['follow_clock']) == (team, follows)
    assert '/filter_node' in facts['nodes']
    # The second team begins when it is ready.
    assert (steps[0].step > 0) == (stamp_from_ros(steps[0].stamp) > 0) == follows


def test_a_run_ends_where_the_clock_that_it_follows_stands_still(tmp_path):
    limits = {'time': 120.0, 'silence': 4.0}
    path = write_scenario(tmp_path / 'far.yaml', [[0.0, 0.0]], limits=limits)
    with beside() as operator:
        clock = operator.node.create_publisher(Clock, '/clock', 10)
        ticks = itertools.count(round(1000.0 / STEP))
        with start(path, tmp_path / 'run', *operator.options, '--follow-clock') as run:
            file = run.bag / 'bag.mcap'

            def tick():
                clock.publish(Clock(clock=stamp_to_ros(round(next(ticks) * STEP * 1e9))))
                return file.exists() and file.stat().st_size > 100_000

            operator.until(tick, 'the run moves')
            run.finish()
    assert run.code == 3, run.output
    assert '/clock, which this run follows, stands still for 4 s' in run.output
    assert run.report['end_reason'] == 'clock_stopped'
    with Bag(run.folder) as recorded:
        *_, last = recorded.messages(['/mambo/cmd_vel'])
    assert last.message.twist.linear.x == last.message.twist.linear.y == 0.0


def test_the_recording_of_a_team_can_be_replayed(teams, tmp_path):
    check_replay(teams['team_b'], tmp_path)

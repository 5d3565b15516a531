"""Two teams in one ROS domain, each in its namespace, on one clock."""

import itertools
import subprocess

import pytest
import yaml
from reserved_domain import reserved_domain
from rosgraph_msgs.msg import Clock
from run_operator import Operator
from scenario_runs import PATIENCE, Run, command, replay

from maasi_filter.ros.conversions import stamp_from_ros, stamp_to_ros
from maasi_sim.run.bag import Bag

pytestmark = pytest.mark.system
STEP = 0.05


def scenario(path, start, target, **limits):
    """Write a scenario with a robot of the same name in each team."""
    content = {
        'version': 1,
        'environment': {'bounds': [[-0.3, 2.4], [-0.3, 2.4]]},
        'targets': {'positions': [target]},
        'robots': {
            'mambo': {
                'type': 'mambo',
                'start': [*start, 1.0],
                'candidates': {'grid': [7, 7], 'spacing': 0.384, 'corner': [-0.1, -0.1]},
            }
        },
        'filter': {'method': 'pmb'},
        'limits': {'time': 120.0, **limits},
    }
    path.write_text(yaml.safe_dump(content))
    return path


def launched(*words):
    return subprocess.Popen(
        words,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def read_until(process, text):
    for line in process.stdout:
        if text in line:
            return
    raise AssertionError(f'never said {text}')


def finished(process, folder):
    output, _ = process.communicate(timeout=PATIENCE)
    return Run(folder, process.returncode, output)


@pytest.fixture(scope='module')
def teams(tmp_path_factory):
    """Return the runs of two teams, by namespace; the first one's clock is that of both.

    The first is paused until the second measures: it would have found all before.
    """
    folder = tmp_path_factory.mktemp('teams')
    first = scenario(folder / 'first.yaml', [1.9, 1.9], [0.3, 0.4])
    second = scenario(folder / 'second.yaml', [0.3, 0.3], [0.6, 0.6])
    with reserved_domain() as domain, pytest.MonkeyPatch.context() as patch:
        for name, value in domain.environment().items():
            patch.setenv(name, value)
        options = ['--domain-id', domain.number, '--namespace']
        operator = Operator(domain)
        leading = launched(*command(first, folder / 'team_a', *options, 'team_a'))
        # A robot that does not take part yet is not paused.
        read_until(leading, 'measurements')
        operator.call('/team_a/search/pause')
        following = launched(
            *command(second, folder / 'team_b', *options, 'team_b', '--follow-clock')
        )
        read_until(following, 'measurements')
        operator.call('/team_a/search/resume')
        operator.close()
        return {
            'team_b': finished(following, folder / 'team_b'),
            'team_a': finished(leading, folder / 'team_a'),
        }


def test_both_teams_find_their_targets(teams):
    for run in teams.values():
        assert run.code == 0, run.output
        assert run.report['end_reason'] == 'all_found'
        assert (run.report['true_found'], run.report['false_found']) == (1, 0)
        assert 0.0 < run.report['time_to_find_all'] < 120.0


@pytest.mark.parametrize('team', ['team_a', 'team_b'])
def test_a_recording_holds_its_own_team_from_its_first_measurement_on(teams, team):
    with Bag(teams[team].bag) as bag:
        facts = bag.scenario()
        shared = {'/clock', '/diagnostics', '/rosout', '/scenario'}
        counts = bag.counts
        assert {topic for topic in counts if not topic.startswith(f'/{team}/')} == shared
        names = {
            status.name for item in bag.messages(['/diagnostics']) for status in item.message.status
        }
        loggers = {item.message.name for item in bag.messages(['/rosout'])}
        batches = [item.message.id for item in bag.messages([f'/{team}/measurement_batch'])]
        asked = {item.message.batch_id for item in bag.messages([f'/{team}/mambo/detections'])}
        steps = [item.message for item in bag.messages([f'/{team}/lockstep/step'])]
        clock = [stamp_from_ros(item.message.clock) for item in bag.messages(['/clock'])]
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
    path = scenario(tmp_path / 'far.yaml', [1.9, 1.9], [0.0, 0.0], silence=4.0)
    folder = tmp_path / 'run'
    with reserved_domain() as domain, pytest.MonkeyPatch.context() as patch:
        for name, value in domain.environment().items():
            patch.setenv(name, value)
        operator = Operator(domain)
        clock = operator.node.create_publisher(Clock, '/clock', 10)
        options = ['--domain-id', domain.number, '--follow-clock']
        run = launched(*command(path, folder, *options))
        ticks = itertools.count(round(1000.0 / STEP))
        bag = folder / 'bag' / 'bag.mcap'

        def tick():
            clock.publish(Clock(clock=stamp_to_ros(round(next(ticks) * STEP * 1e9))))
            return bag.exists() and bag.stat().st_size > 100_000

        operator.until(tick, 'the run moves')
        done = finished(run, folder)
        operator.close()
    assert done.code == 3, done.output
    assert '/clock, which this run follows, stands still for 4 s' in done.output
    assert done.report['end_reason'] == 'clock_stopped'
    with Bag(folder) as recorded:
        *_, last = recorded.messages(['/mambo/cmd_vel'])
    assert last.message.twist.linear.x == last.message.twist.linear.y == 0.0


def test_the_recording_of_a_team_can_be_replayed(teams, tmp_path):
    done = replay(teams['team_b'], tmp_path)
    assert done.returncode == 0, done.stdout
    assert 'equal to the bit' in done.stdout

"""A short selection of the fault campaign, and that its judgement finds what is wrong."""

import json
import subprocess
import sys

import campaign
import pytest
from builtin_interfaces.msg import Time
from campaign import PASSED, WRONG_INPUT, main, summary
from chaos_cases import Case, all_cases
from chaos_execution import Outcome
from chaos_verdict import judge
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock

from maasi_filter.ros.conversions import stamp_to_ros
from maasi_msgs.msg import AgentState, FilterUpdate, FoundTarget, FoundTargetArray, MeasurementBatch
from maasi_sim.run.bag import BagWriter, load_types

pytestmark = pytest.mark.system

# Case, and what its run says.
SELECTION = {
    'search-free-respawn-kill-middle-filter_node': '/filter_node was killed by SIGKILL',
    'search-free-end-hang-middle-turtlebot_driver': ': /turtlebot/driver',
    'search-free-respawn-hang-middle-planner_node': '/planner_node hangs',
    'search-lockstep-end-hang-middle-mambo_driver': '/mambo/driver for ',
    'search-lockstep-end-kill-middle-sim_node': 'ended: /sim_node was killed by SIGKILL',
    'search-lockstep-respawn-kill-middle-filter_node+mambo_driver': '',
}
ENDS = {1: ('node_hung', ['hung']), 3: ('node_hung', []), 4: ('node_died', ['died'])}


def test_a_selection_of_the_campaign_passes(tmp_path):
    file = tmp_path / 'results.json'
    command = [sys.executable, campaign.__file__, '--case', *SELECTION, '--jobs', '3']
    command += ['--json', str(file), '--out', str(tmp_path / 'runs')]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500.0, check=False)
    assert done.returncode == PASSED, done.stdout + done.stderr
    results = json.loads(file.read_text())
    assert results['passed'] == len(SELECTION)
    assert not results['failed'] and not results['left_out']
    assert {item['name'] for item in results['cases']} == set(SELECTION)
    for number, (name, said) in enumerate(SELECTION.items()):
        output = (tmp_path / 'runs' / name / 'output.txt').read_text()
        assert said in output, output
        report = json.loads((tmp_path / 'runs' / name / 'run' / 'report.json').read_text())
        events = [item['event'] for item in report['events'] if 'node' in item]
        if number in ENDS:
            assert (report['end_reason'], events) == ENDS[number]
        else:
            assert events[-1] == 'restarted'


def test_wrong_arguments_are_refused(tmp_path, capsys):
    assert main(['--case', 'nothing*']) == WRONG_INPUT
    assert "read 'nothing*'" in capsys.readouterr().err
    with pytest.raises(SystemExit) as refused:
        main(['--jobs', '0'])
    assert refused.value.code == WRONG_INPUT
    (tmp_path / 'file').touch()
    assert main(['--out', str(tmp_path)]) == WRONG_INPUT
    capsys.readouterr()
    assert main(['--list', '--case', 'buildings-*', '--case', 'mavlink-*']) == PASSED
    names = capsys.readouterr().out.split()
    assert 'buildings-lockstep-end-kill-middle-sim_node' in names
    assert {name.partition('-')[0] for name in names} == {'buildings', 'mavlink'}
    assert len(all_cases()) == len({case.name for case in all_cases()}) == 171


KILLED = Case('kill', ('/filter_node',), 'middle', False, False)
PAUSED_DRONE = Case('pause', ('/drone/driver',), kind='mavlink')
MOVING = Odometry()
MOVING.twist.twist.linear.x = 0.2
MOVES = '{} moves at {:.2f} m/s at {} s, though {} is silent since {} s'
ASKED = MeasurementBatch(id=1)


def state(x=0.0, speed=0.0):
    message = AgentState()
    message.pose.pose.position.x, message.twist.linear.x = x, speed
    return message


@pytest.fixture
def problems_of(tmp_path):
    """Return the function that judges a run of 20 s by its messages: topic, time and message."""

    def judged(*messages, code=3, output='/filter_node', left=(), case=KILLED):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        (folder / 'report.json').write_text('{"end_reason": "time_limit"}')
        clock = [('/clock', second, Clock(clock=Time(sec=second))) for second in range(20)]
        with BagWriter(folder / 'bag', load_types()) as bag:
            for topic, time, message in sorted((*clock, *messages), key=lambda item: item[1]):
                if hasattr(message, 'header'):
                    message.header.stamp = stamp_to_ros(round(time * 1e9))
                package = type(message).__module__.partition('.')[0]
                bag.add_topic(topic, f'{package}/msg/{type(message).__name__}')
                bag.write(topic, round(1e9 * time), serialize_message(message))
        return judge(case, Outcome(folder, code, output, True, 1.0, list(left)))

    return judged


def test_a_wrong_ending_and_lost_targets_are_found(problems_of, tmp_path):
    problems = problems_of(code=0, output='', left=['filter_node --ros-args'])
    names = [item.partition(':')[0] for item in problems]
    assert names == ['exit code', 'output', 'processes left']
    targets = [FoundTarget(id=number) for number in (1, 2)]
    both, one = (FoundTargetArray(targets=found) for found in (targets, targets[1:]))
    problems = problems_of(('/found_targets', 1, both), ('/found_targets', 2, one))
    assert problems == ['found_targets: without [1] that were found']
    problems = judge(KILLED, Outcome(tmp_path / 'none', 3, '/filter_node', True, 1.0, []))
    assert [item.partition(':')[0] for item in problems] == ['report', 'recording']


def test_a_robot_that_moves_when_it_must_stand_is_found(problems_of):
    command = TwistStamped()
    command.twist.linear.x = 0.2
    gap, last = problems_of(
        ('/mambo/state', 1.0, state()),
        # The first one is in the time that it has to stop.
        ('/mambo/odom', 3.0, MOVING),
        ('/mambo/odom', 10.0, MOVING),
        ('/turtlebot/cmd_vel', 1.0, TwistStamped()),
        ('/turtlebot/cmd_vel', 2.0, command),
    )
    assert gap == MOVES.format('mambo', 0.2, 10.0, 'its driver', 1.0)
    assert last.startswith('turtlebot: the last command is (0.2,')


def test_a_driver_that_its_guard_hears_again_is_not_silent_before_it_is_recorded(problems_of):
    back = ('/rosout', 3.0, Log(name='mambo.guard', msg='driver available again'))
    states = [('/mambo/state', time, state()) for time in (1.0, 7.0)]
    messages = [*states, ('/mambo/odom', 5.0, MOVING)]
    assert problems_of(*messages) == [MOVES.format('mambo', 0.2, 5.0, 'its driver', 1.0)]
    assert problems_of(*messages, back) == []
    # Without a state afterwards that does not last.
    late = ('/mambo/odom', 6.0, MOVING)
    found = problems_of(*messages, back, late)
    assert found == [MOVES.format('mambo', 0.2, 6.0, 'its driver', 3.0)]


def test_a_filter_is_silent_only_while_a_batch_waits_for_it(problems_of):
    messages = [
        ('/measurement_batch', 1.0, ASKED),
        ('/filter_update', 2.0, FilterUpdate(batch_id=1)),
        ('/mambo/odom', 10.0, MOVING),
        ('/mambo/odom', 18.0, MOVING),
    ]
    assert problems_of(*messages) == []
    found = problems_of(*messages, ('/measurement_batch', 9.5, MeasurementBatch(id=2)))
    assert found == [MOVES.format('mambo', 0.2, 18.0, 'the filter', 9.5)]


@pytest.mark.parametrize(('time', 'allowed', 'fast'), [(9.0, 0.6, 1.5), (13.0, 0.05, 0.6)])
def test_a_drone_that_is_not_held_without_the_filter_is_found(problems_of, time, allowed, fast):
    wrong = [MOVES.format('drone', fast, time, 'the filter', 1.0)]
    for speed, problems in ((allowed, []), (fast, wrong)):
        messages = ('/measurement_batch', 1.0, ASKED), ('/drone/state', time, state(0.0, speed))
        assert problems_of(*messages, code=0, case=PAUSED_DRONE) == problems


def test_a_vehicle_that_flies_past_its_last_set_point_is_found(problems_of):
    def judged(silence, way, speed):
        # The second one is of a restarted driver, which does not know the place yet.
        times = {1.0: state(5.0, 2.8), 2.0: state(), 1.0 + silence: state(5.0 + way, speed)}
        messages = [('/drone/state', time, message) for time, message in times.items()]
        return problems_of(*messages, code=0, case=PAUSED_DRONE)

    assert judged(3.0, 2.8, 0.2) == judged(6.0, 3.0, 0.01) == []
    assert judged(3.0, 6.0, 0.2) == ['drone flew 6.0 m while its driver was silent, 1.0 to 4.0 s']
    assert judged(6.0, 2.8, 0.2) == [
        'drone still moves at 0.20 m/s while its driver was silent, 1.0 to 7.0 s'
    ]


def test_the_summary_counts_by_kind():
    results = [{'name': KILLED.name, 'problems': found} for found in ([], ['exit code'])]
    content = summary(results, 1, 5)
    assert content['counts'] == {'search free end kill middle one': {'passed': 1, 'failed': 1}}
    assert (content['passed'], content['failed'], content['left_out']) == (1, 1, 5)

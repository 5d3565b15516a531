"""The event log of a run: what is in it, thinned, packed, and from a search in one process."""

import base64
import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseArray
from nav_msgs.msg import OccupancyGrid
from rclpy.serialization import serialize_message
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from std_msgs.msg import Header, String

from maasi_filter.ros.conversions import stamp_to_ros
from maasi_msgs import msg
from maasi_planner.conversions import decision_to_ros
from maasi_planner.motion import RobotState, make_motion
from maasi_planner.settings import MotionSettings
from maasi_planner.team import Decision, single_choice
from maasi_sim.run.bag import BagWriter, load_types
from maasi_sim.run.missions import load_mission
from maasi_sim.run.view.event_log import EventLog, line, thin
from maasi_sim.run.view.event_maker import ENDED, LEFT, SILENT, EventMaker
from maasi_sim.run.view.recording import event_log, facts_for, read_events
from maasi_sim.run.view.scene import empty_scene, scene_of, scene_of_facts
from maasi_sim.search import search

ROOT = Path(__file__).resolve().parents[2]


def state(seconds, **fields):
    message = msg.AgentState(robot='rover', **fields)
    message.header.stamp = stamp_to_ros(round(seconds * 1e9))
    message.pose.pose.orientation.w = 1.0
    return message


class Received:
    def __init__(self, scene=None, waits=False, on_restart=None):
        self.events = []
        self.maker = EventMaker(scene or empty_scene(), self.events.append)
        self.facts = facts_for(self.maker.scene, waits, on_restart)

    def add(self, topic, message):
        package = type(message).__module__.split('.')[0]
        kind = f'{package}/msg/{type(message).__name__}'
        for fact in self.facts.of(topic, kind, message):
            self.maker.add(fact)

    def of(self, kind):
        return [event for event in self.events if event[1] == kind]


@pytest.fixture
def received():
    return Received()


def test_states_are_one_per_period_except_where_the_robot_says_something_else(received):
    # One that is not finite is left out.
    broken = state(0.0)
    broken.pose.pose.position.x = math.nan
    received.add('/rover/state', broken)
    for step in range(10):
        battery = math.inf if step == 0 else 0.5
        moving = state(0.05 * step, goal_status=msg.AgentState.MOVING, battery=battery)
        received.add('/rover/state', moving)
    assert [event[4] for event in received.of('robot')] == [-1.0] + 4 * [0.5]
    lost = state(0.5, goal_status=msg.AgentState.UNAVAILABLE, reason='its link is lost')
    received.add('/rover/state', lost)
    assert received.of('robot')[-1][5:] == [msg.AgentState.UNAVAILABLE, 'its link is lost']
    assert [event[5] for event in received.of('log')] == ['unavailable: its link is lost']
    assert all(json.loads(line(event)) for event in received.events)


def step(seconds, *robots):
    return msg.LockstepStep(robots=list(robots), stamp=stamp_to_ros(round(seconds * 1e9)))


def test_robots_that_left_or_are_silent_are_not_on_the_way_and_none_is_at_the_end(received):
    for seconds in range(7):
        present = ['crawler', 'rover', 'walker'] if seconds < 2 else ['crawler', 'rover']
        received.add('/lockstep/step', step(float(seconds), *present))
        # One falls silent; the other's driver still publishes after it has left.
        for name in ('rover', 'crawler', 'walker'):
            if name != 'crawler' or seconds < 2:
                message = state(float(seconds), goal_status=msg.AgentState.MOVING)
                message.robot = name
                received.add(f'/{name}/state', message)
    received.maker.end()
    statuses = {
        name: [(event[0], *event[5:]) for event in received.of('robot') if event[2] == name]
        for name in ('crawler', 'rover', 'walker')
    }
    assert statuses['walker'] == [(0.0, 1, ''), (1.0, 1, ''), (2.0, LEFT, '')]
    assert statuses['crawler'][1:] == [(1.0, 1, ''), (6.0, SILENT, 'no state for 3 s')]
    assert statuses['rover'][-1] == (6.0, ENDED, '')
    said = [event[4:] for event in received.of('log')]
    assert said == [['walker', 'left'], ['crawler', 'no state for 3 s']]


def test_what_comes_before_the_first_step_is_taken_at_its_time():
    received = Received(waits=True)
    # A run with real robots may wait for minutes.
    for _ in range(2000):
        received.add('/rover/state', state(9.0))
    assert received.events == []
    for seconds in (10.0, 10.5):
        received.add('/lockstep/step', step(seconds, 'rover'))
        received.add('/rover/state', state(seconds))
    assert [event[0] for event in received.of('robot')] == [0.0, 0.5]


def test_modes_of_robots_and_the_ending_are_events_and_said_once(received):
    status = DiagnosticStatus(name='/team/planner_node', message='active')
    status.values = [KeyValue(key='search', value='rover paused, walker searching')]
    for _ in range(2):
        received.add('/diagnostics', DiagnosticArray(status=[status]))
    assert received.of('mode') == [[0.0, 'mode', '/team/planner_node', status.values[0].value]]
    received.add('/rover/state', state(0.0, goal_status=msg.AgentState.MOVING))
    received.add('/ending', String(data='node_died\n/filter_node exited with 1'))
    # At the end of a recording.
    received.maker.end()
    assert received.of('end') == [[0.0, 'end', '', 'node_died', '/filter_node exited with 1']]
    assert [event[5] for event in received.of('robot')] == [1, ENDED]


def test_candidates_that_are_not_allowed_have_no_objective(received):
    candidates = [
        msg.Candidate(objective=-1e30),
        msg.Candidate(objective=0.5, length=7, measurements=2),
    ]
    robot = msg.RobotDecision(robot='rover', chosen=1, candidates=candidates)
    received.add('/decisions', msg.PlanDecision(planner='maasi', robots=[robot], explored=0.25))
    (plan,) = received.of('plan')
    assert plan[3:5] == ['maasi', 0.25]
    assert [item[6:] for item in plan[7][0][4]] == [[None, 0, 0], [0.5, 7, 2]]


def types_without_tours():
    text = (ROOT / 'maasi_msgs/msg/RobotDecision.msg').read_text()
    kept = [line for line in text.splitlines() if ' tour ' not in line]
    assert len(kept) == len(text.splitlines()) - 1
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in ('Candidate', 'PlanDecision'):
        content = (ROOT / f'maasi_msgs/msg/{name}.msg').read_text()
        store.register(get_types_from_msg(content, f'maasi_msgs/msg/{name}'))
    store.register(get_types_from_msg('\n'.join(kept), 'maasi_msgs/msg/RobotDecision'))
    return store


def test_the_rest_of_a_tour_is_recorded_and_recordings_without_it_are_read(tmp_path):
    points = np.array([[1.0, 2.0, 3.0]])
    motion = make_motion(MotionSettings(speed=1.0), None, 0.1)
    prediction = motion.predict(RobotState.at_rest((0.0, 0.0, 3.0)), points, 0.1)
    for name, types, tour in (
        ('now', load_types(), [[4.0, 2.0, 3.0], [4.0, 5.0, 3.0]]),
        ('before', types_without_tours(), []),
    ):
        robot = single_choice(points, prediction, 0, '')
        robot.tour = np.array(tour).reshape(-1, 3)
        decided = Decision(0, {'rover': robot})
        made = decision_to_ros(decided, {'rover': 3}, 'tour', 0, 0.0, Header())
        data = serialize_message(made)
        with BagWriter(tmp_path / name, types) as writer:
            writer.add_topic('/decisions', 'maasi_msgs/msg/PlanDecision')
            # The length of the list is what is last.
            writer.write('/decisions', 0, data if tour else data[:-4])
        (plan,) = [event for event in read_events(tmp_path / name).events if event[1] == 'plan']
        (row,) = plan[7]
        assert row[:4] == ['rover', 3, 0, [1.0, 2.0, 3.0]] and row[6] == tour


def test_bounds_are_learnt_from_the_exploration_function_without_a_scenario(received):
    grid = OccupancyGrid(data=[0, 100, 50, 50, 0, 0])
    grid.info.resolution, grid.info.width, grid.info.height = 0.5, 3, 2
    grid.info.origin.position.x = grid.info.origin.position.y = -0.25
    received.add('/exploration', grid)
    assert received.maker.scene['bounds'] == [[0.0, 1.0], [0.0, 0.5]]
    # By x, then by y: e of (1, 0) is 1.
    assert received.of('map')[0][5:] == [[3, 2, 1], '0iz0i0', None]


def test_found_targets_are_scored_where_the_truth_is_known():
    scenario = load_mission('mambo_turtlebot').scenario
    received = Received(scene_of('demo', scenario))
    targets = [(float(x), float(y)) for x, y in scenario.world(scenario.seed).targets]
    truth = PoseArray(poses=[Pose(position=Point(x=x, y=y)) for x, y in targets])
    received.add('/ground_truth/targets', truth)
    place = Point(x=targets[0][0] + 0.01, y=targets[0][1])
    both = [
        msg.FoundTarget(id=1, robot='mambo', position=place),
        msg.FoundTarget(id=2, robot='turtlebot'),
    ]
    # A filter of one robot counts only what it found itself.
    received.add('/mambo/found_targets', msg.FoundTargetArray(targets=both))
    assert [item[0] for item in received.of('found')[-1][3]] == [1]
    assert received.of('score')[-1][3:7] == [1, 11, 0, pytest.approx(0.01, abs=1e-4)]
    received.add('/team/found_targets', msg.FoundTargetArray(targets=both))
    assert [item[0] for item in received.of('found')[-1][3]] == [1, 2]


def test_time_that_jumps_back_begins_another_run():
    made = []

    def begin():
        received.maker = EventMaker(empty_scene(), received.events.append)
        made.append(received.maker)

    received = Received(on_restart=begin)
    received.add('/rover/state', state(100.0))
    received.add('/rover/state', state(130.0))
    # What comes a little late, or of another topic, as in a bag that is played fast, begins none.
    received.add('/rover/state', state(128.0))
    received.add('/lockstep/step', step(102.0))
    assert made == []
    received.add('/rover/state', state(101.0))
    assert len(made) == 1
    assert [event[0] for event in received.events] == [0.0, 30.0, 0.0]


def unpacked(text):
    scene, *events = gzip.decompress(base64.b64decode(text)).decode().split('\n')
    return json.loads(scene), [json.loads(item) for item in events]


def test_a_long_run_is_thinned_until_it_fits_and_says_so():
    events = []
    for number, place in enumerate(np.random.default_rng(1).normal(size=(20000, 4)).round(4)):
        events.append([number / 10, 'robot', 'rover', place.tolist(), 0.5, 1, ''])
        if number % 100 == 0:
            events.append([number / 10, 'log', '', 'found', 'rover', 'target'])
    log = EventLog({'name': 'long'}, events)
    assert unpacked(log.packed()) == (log.scene, log.events)
    packed = log.packed(100_000)
    assert len(packed) <= 100_000
    scene, kept = unpacked(packed)
    assert scene['thinned'] >= 0.2 and kept[-1] == events[-1]
    lines = [event for event in events if event[1] == 'log']
    assert [event for event in kept if event[1] == 'log'] == lines
    # Detections and the end are kept.
    seen = [[time, 'seen', 'a', [0, 0, 0], []] for time in (0.0, 0.1, 0.2, 0.3)]
    seen[2][4].append([1, 0, 0, 0, 0, 0])
    assert [event[0] for event in thin(seen, 10.0)] == [0.0, 0.2, 0.3]
    # So is each plan at buildings, to which a line of the log leads.
    plans = [[2], [2], [2, 3], [3], [3], [3]]
    decided = [
        [0.1 * step, 'cuboid', 'a', 'searching', 'optimal', [0, 0, 0], [], plan, [], False]
        for step, plan in enumerate(plans)
    ]
    assert [event[7] for event in thin(decided, 10.0)] == [[2], [2, 3], [3], [3]]


def test_scenes_are_the_same_from_a_scenario_and_from_what_a_recording_says_of_it():
    for name in ('mambo_turtlebot_obstacles', 'ranging_pair_3d', 'buildings_four'):
        scenario = load_mission(name).scenario
        scene = scene_of_facts({'name': name, 'seed': 3, 'scenario': scenario.content()})
        assert scene == scene_of(name, scenario, 3)
        assert json.loads(line(scene)) == scene
    assert len(scene['cuboids']) == 32 and len(scene['objects']) == 2
    # Each cuboid is for a part of a face; the parts make up the four walls of both.
    sizes = [np.diff(sides)[:, 0] for _, _, sides in scene['cells']]
    assert len(sizes) == 32
    assert sum(np.prod(size[size > 0.0]) for size in sizes) == pytest.approx(8 * 60.0**2)
    for owner, face, sides in scene['cells']:
        axis, upper = divmod(face, 2)
        assert sides[axis] == 2 * [scene['objects'][owner][axis][upper]]
    # Of a planner with another objective there are no weights.
    changes = {'planner': (('planner', 'name'), 'maas')}
    assert 'weights' not in scene_of('maas', load_mission('mambo_turtlebot', changes).scenario)


def test_the_scene_has_the_geofences_that_drivers_keep_to():
    fence = [[0.0, 2.0], [0.0, 2.0], [0.5, 1.5]]
    changes = {'given': (('robots', 'mambo', 'mambo', 'geofence'), fence)}
    robots = scene_of('', load_mission('mambo_turtlebot_wifi', changes).scenario)['robots']
    assert robots['mambo']['fence'] == fence and 'fence' not in robots['turtlebot']
    changes = {
        'link': (('robots', 'drone', 'link'), 'mavlink'),
        'arm': (('robots', 'drone', 'mavlink', 'arm'), True),
    }
    scenario = load_mission('drone_rov', changes).scenario
    drone = scenario.robots['drone']
    *sides, z = scene_of('', scenario)['robots']['drone']['fence']
    reach = np.array([-drone.radius, drone.radius])
    assert np.array(sides) == pytest.approx(scenario.environment.array()[:2] + reach)
    assert z[0] <= drone.start[2] < z[1]


@pytest.fixture(scope='module')
def result():
    scenario = load_mission('ranging_drone_3d').scenario
    return search(scenario, 1)


def test_a_search_in_one_process_leaves_the_same_events(result):
    log = event_log(result, 'drone')
    found = [event for event in log.events if event[1] == 'found'][-1]
    assert [item[0] for item in found[3]] == [item.id for item in result.found_targets]
    assert np.allclose(found[3][0][1:4], result.found_targets[0].position, atol=0.01)
    plans = [event for event in log.events if event[1] == 'plan']
    assert len(plans) == len(result.decisions)
    chosen = plans[0][7][0]
    decision = result.decisions[0].robots['drone']
    assert chosen[2] == decision.chosen and chosen[5] == decision.reason
    updates = [event for event in log.events if event[1] == 'filter']
    assert updates[-1][5] == result.total_measurements
    # As from the nodes, once a second, and not only at decisions.
    times = [event[0] for event in log.events if event[1] == 'map']
    assert np.diff(times).max() <= 2.0 and len(times) > 2 * len(plans)
    # Charges of the battery, which falls, and statuses of the goal.
    states = [event for event in log.events if event[1] == 'robot']
    charges = [event[4] for event in states]
    assert charges[0] == 1.0 and 0.0 < charges[-1] < 1.0 and max(np.diff(charges)) <= 0.0
    assert {event[5] for event in states[:-1]} <= {0, 1, 2} and states[1][5] == 1


def test_the_objective_is_made_of_its_terms_with_the_weights_of_the_scene(result):
    log = event_log(result)
    weights = log.scene['weights']
    plans = [robot for event in log.events if event[1] == 'plan' for robot in event[7]]
    rows = [row for robot in plans for row in robot[4] if row[6] is not None]
    assert len(rows) > 100
    for _, _, _, control, refinement, exploration, objective, length, _ in rows:
        gain = weights['alpha'] * refinement + weights['beta'] * exploration
        expected = (gain - weights['control'] * control) / length
        assert objective == pytest.approx(expected, rel=1e-3, abs=1e-6)

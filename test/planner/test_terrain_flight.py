"""Flight over terrain: heights above ground along the path, and goals that are too low."""

from itertools import pairwise

import numpy as np
import pytest

from maasi_drivers.agent.flight_rules import flight_volume
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus, WaypointFollower
from maasi_drivers.settings.vehicles import FlightSettings
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_planner.motion import RobotState, make_motion
from maasi_planner.settings import MotionSettings, RobotModel
from maasi_planner.terrain_frame import above_ground

BOUNDS = [[-100.0, 100.0], [-100.0, 100.0]]


def hilly(tmp_path, function):
    axis = np.arange(-100.0, 101.0, 5.0)
    x, y = np.meshgrid(axis, axis[::-1])
    rows = '\n'.join(' '.join(f'{value:.3f}' for value in row) for row in function(x, y))
    head = f'ncols {len(axis)}\nnrows {len(axis)}\nxllcenter -100\nyllcenter -100\ncellsize 5\n'
    (tmp_path / 'ground.asc').write_text(head + rows)
    given = {'bounds': BOUNDS, 'terrain': str(tmp_path / 'ground.asc')}
    return Area(EnvironmentSettings.model_validate(given))


def motion(model='constant_speed', speed=8.0, acceleration=3.0):
    return MotionSettings(
        model=model, speed=speed, acceleration=acceleration, clearance=2.0, tolerance=1.0
    )


def robot(height=20.0, **settings):
    content = {'motion': motion(**settings), 'start': [0.0, 0.0, height], 'radius': 0.5}
    return RobotModel.model_validate(content)


def flown(area, one, start, goal, seconds=200.0, step=0.1):
    """Return the positions (n, 3) of a flight between positions above ground, until it ends."""
    follower = WaypointFollower(make_motion(one.motion, area, one.radius))
    begin = RobotState.at_rest(area.above_ground(start))
    body, path = follower.motion.body(begin), [begin.pose.position]
    follower.adopt(Goal(1, 0, area.above_ground(goal)))
    for _ in range(round(seconds / step)):
        command, _ = follower.update(body.robot_state())
        body.step(command, step)
        path.append(body.robot_state().pose.position)
        if follower.status == GoalStatus.REACHED:
            return np.array(path)
    raise AssertionError('not reached')


def gauss(x, y):
    return 60.0 * np.exp(-0.5 * (x * x + y * y) / 25.0**2)


def cliff(x, y):
    return np.where(x > 10.0, 50.0, 0.0)


def rough(seed):
    def ground(x, y):
        generator = np.random.default_rng(seed)
        smooth = sum(
            generator.uniform(2.0, 8.0)
            * np.sin(generator.uniform(0.02, 0.15) * x + generator.uniform(0.02, 0.15) * y + phase)
            for phase in range(5)
        )
        return smooth + generator.uniform(0.0, 3.0, x.shape)

    return ground


@pytest.mark.parametrize('ground', [gauss, cliff, *map(rough, range(3))])
@pytest.mark.parametrize('model', ['constant_speed', 'quadrotor'])
@pytest.mark.parametrize('height', [6.0, 25.0])
def test_a_path_stays_clear_of_the_ground(tmp_path, ground, model, height):
    area, one = hilly(tmp_path, ground), robot(height, model=model)
    for start, goal in (([-90, -10], [90, 15]), ([80, 80], [-70, -85]), ([0, 95], [5, -95])):
        path = flown(area, one, [*start, height], [*goal, height])
        ends = area.terrain.height(start), area.terrain.height(goal)
        assert path[0, 2] - ends[0] == pytest.approx(height)
        assert path[-1, 2] - ends[1] == pytest.approx(height, abs=1.0)
        least = min(area.terrain.clearance(a, b) for a, b in pairwise(path))
        # Radius and clearance; the straight lines between steps cut the path by less than 0.1 m.
        assert least >= 2.5 - 0.1


def test_flat_ground_is_flown_as_without_terrain(tmp_path):
    flat, plain = hilly(tmp_path, lambda x, y: 0.0 * x), Area(BOUNDS)
    one = robot()
    paths = [flown(area, one, [-50, 0, 20.0], [60, 30, 20.0]) for area in (flat, plain)]
    assert len(paths[0]) == pytest.approx(len(paths[1]), abs=1)
    shorter = min(map(len, paths))
    assert np.abs(paths[0][:shorter] - paths[1][:shorter]).max() < 1e-6


def test_states_above_ground(tmp_path):
    area = hilly(tmp_path, lambda x, y: 0.2 * x - 0.1 * y)
    state = RobotState.at_rest([10.0, 20.0, 30.0])
    state.velocity[:] = 2.0, 3.0, 0.5
    level = above_ground(state, area.terrain)
    assert level.pose.position == pytest.approx([10.0, 20.0, 30.0])
    assert level.velocity == pytest.approx([2.0, 3.0, 0.5 - 0.4 + 0.3], abs=1e-3)
    assert above_ground(state, None) is state


def test_goals_below_the_clearance_are_refused_and_set_points_raised(tmp_path):
    area, one = hilly(tmp_path, gauss), robot()
    volume = flight_volume(area, one, FlightSettings())
    ground = area.terrain.height([10.0, 0.0])
    assert volume.goal_problem([10.0, 0.0, ground + 20.0]) == ''
    problem = volume.goal_problem([10.0, 0.0, 20.0])
    assert problem.startswith('.z: read 20, -35.')
    assert 'm above the ground; allowed is 2.5 to 81 m, the geofence' in problem
    raised = volume.nearest_inside(np.array([10.0, 0.0, 20.0]))
    assert raised == pytest.approx([10.0, 0.0, ground + 2.5])
    assert volume.distance_outside(np.array([10.0, 0.0, ground + 1.0])) == pytest.approx(1.5)
    assert volume.drift_problem(np.array([10.0, 0.0, ground + 90.0])).startswith('z at 90.00 m')
    assert volume.drift_problem(np.array([10.0, 0.0, ground])) == ''

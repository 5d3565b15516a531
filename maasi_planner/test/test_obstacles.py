"""Ways around obstacles: nothing is ever touched, and everything is reached."""

import numpy as np
import pytest

from maasi_planner import MotionSettings, Obstacles, RobotState, make_motion
from maasi_planner.obstacles import KeepOut

UNICYCLE = {
    'model': 'unicycle',
    'speed': 0.2,
    'yaw_rate': 1.8,
    'acceleration': 0.5,
    'yaw_acceleration': 4.0,
}
WINDOW = {**UNICYCLE, 'avoidance': 'dynamic_window'}
ROBOTS = [
    {'model': 'mambo', 'speed': 0.4, 'approach_rate': 1.2},
    {'model': 'quadrotor', 'speed': 0.4},
    {'model': 'constant_speed', 'speed': 0.4, 'acceleration': 0.5},
    UNICYCLE,
]
SPACE = {'speed': 4.0, 'tolerance': 1.0, 'clearance': 3.0}


def discs(centres, radii):
    """Return cylinders with centres (n, 2) and radii, one for all or (n,)."""
    places = np.zeros((len(centres), 3))
    places[:, :2] = centres
    return Obstacles(places, np.full(len(centres), radii), np.zeros(len(centres), dtype=bool))


def random_discs(rng):
    number = int(rng.integers(1, 7))
    return discs(rng.uniform(-0.1, 2.2, (number, 2)), rng.uniform(0.05, 0.3, number))


def random_spheres(rng):
    number = int(rng.integers(1, 8))
    centres, radii = rng.uniform(20, 240, (number, 3)), rng.uniform(5, 40, number)
    return Obstacles(centres, radii, np.ones(number, dtype=bool))


def least_room(motion, prediction):
    obstacles = motion.keep_out.obstacles
    offsets = prediction.positions.reshape(-1, 1, 3) - obstacles.centres
    offsets[:, ~obstacles.spheres, 2] = 0.0
    return (np.linalg.norm(offsets, axis=2) - obstacles.radii).min()


def check_way(motion, state, goals, step, room):
    prediction = motion.predict(state, goals, step)
    assert prediction.reached.all()
    assert least_room(motion, prediction) >= room


def check_random(settings, obstacles, seed, number, bounds, height, radius):
    rng = np.random.default_rng(seed)
    motion = make_motion(MotionSettings(**settings), obstacles(rng), radius)
    flat = height is not None

    def place():
        found = rng.uniform(*bounds, 3)
        return np.append(found[:2], height) if flat else found

    start = place()
    while motion.keep_out.obstacles.distances(start).min() <= radius + motion.settings.clearance:
        start = place()
    moved = [motion.keep_out.moved_out(start, place()) for _ in range(number)]
    goals = np.array([goal for goal in moved if goal is not None]).reshape(-1, 3)
    if len(goals):
        state = RobotState.at_rest(start, float(rng.uniform(-3.0, 3.0)))
        check_way(motion, state, goals, 0.05 if flat else 0.1, radius)


@pytest.mark.parametrize('settings', [*ROBOTS, WINDOW])
def test_no_robot_enters_an_obstacle(settings):
    height = 0.0 if settings['model'] == 'unicycle' else 1.0
    seeds, goals = (40, 1) if settings is WINDOW else (250, 3)
    for seed in range(seeds):
        check_random(settings, random_discs, seed, goals, (-0.2, 2.3), height, 0.1)


@pytest.mark.parametrize('model', ['constant_speed', 'mambo'])
def test_spheres_are_flown_around(model):
    for seed in range(60):
        settings = SPACE | {'model': model}
        check_random(settings, random_spheres, seed, 1, (0.0, 260.0), None, 1.0)


def test_trap_of_overlapping_discs():
    """A pocket open to the robot's side, with the waypoint behind it, is left and gone around."""
    obstacles = discs([[1.4, 0.6], [1.55, 0.8], [1.6, 1.0], [1.55, 1.2], [1.4, 1.4]], 0.12)
    for settings in (*ROBOTS, WINDOW):
        motion = make_motion(MotionSettings(**settings), obstacles, 0.08)
        check_way(motion, RobotState.at_rest([1.2, 1.0, 0.0]), [[2.2, 1.0, 0.0]], 0.05, 0.08)


def test_waypoint_in_an_obstacle_is_moved_towards_the_robot():
    """001, section 4.3: to the minimum admissible distance, on the line of robot and waypoint."""
    obstacles = discs([[1.0, 1.0]], 0.3)
    keep_out = KeepOut(obstacles, 0.1, 0.05)
    robot = np.array([0.0, 1.0, 0.5])
    moved = keep_out.moved_out(robot, [1.1, 1.0, 0.5])
    assert moved == pytest.approx([1.0 - 0.45, 1.0, 0.5], abs=1e-3)
    assert keep_out.moved_out(robot, [0.2, 0.2, 0.5]) == pytest.approx([0.2, 0.2, 0.5])
    rng = np.random.default_rng(0)
    for _ in range(200):
        start, point = np.append(rng.uniform(0, 2, 2), 0.0), np.append(rng.uniform(0, 2, 2), 0.0)
        moved = keep_out.moved_out(start, point)
        if moved is None:
            assert obstacles.distances(start)[0] < 0.15
            continue
        assert obstacles.distances(moved)[0] >= 0.1 + 0.9 * 0.05
        line, part = point - start, moved - start
        assert abs(line[0] * part[1] - line[1] * part[0]) < 1e-9
        assert float(part @ line) <= float(line @ line) + 1e-9


def test_robot_between_two_obstacles_has_no_way():
    obstacles = discs([[1.0, 0.0], [1.0, 0.5], [0.5, 0.25], [1.5, 0.25]], 0.24)
    motion = make_motion(MotionSettings(model='unicycle', speed=0.2), obstacles, 0.1)
    prediction = motion.predict(RobotState.at_rest([-0.2, 0.25, 0.0]), [[1.0, 0.25, 0.0]], 0.05)
    assert not prediction.reached[0]
    assert least_room(motion, prediction) >= 0.1

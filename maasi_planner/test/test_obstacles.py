"""Ways around obstacles: nothing is ever touched, and everything is reached."""

from __future__ import annotations

import numpy as np
import pytest

from maasi_filter.settings import Obstacle
from maasi_planner import MotionSettings, Obstacles, RobotState, make_motion
from maasi_planner.obstacles import KeepOut

ROBOTS = {
    'mambo': {'model': 'mambo', 'speed': 0.4, 'approach_rate': 1.2},
    'quadrotor': {'model': 'quadrotor', 'speed': 0.4},
    'constant_speed': {'model': 'constant_speed', 'speed': 0.4, 'acceleration': 0.5},
    'unicycle': {
        'model': 'unicycle',
        'speed': 0.2,
        'yaw_rate': 1.8,
        'acceleration': 0.5,
        'yaw_acceleration': 4.0,
    },
}
WINDOW = {**ROBOTS['unicycle'], 'avoidance': 'dynamic_window'}


def discs(rng):
    number = int(rng.integers(1, 7))
    centres = np.zeros((number, 3))
    centres[:, :2] = rng.uniform(-0.1, 2.2, (number, 2))
    return Obstacles(centres, rng.uniform(0.05, 0.3, number), np.zeros(number, dtype=bool))


def free_place(rng, motion, low, high, height=None):
    while True:
        place = rng.uniform(low, high, 3)
        if height is not None:
            place[2] = height
        room = motion.keep_out.radius + motion.settings.clearance
        if (motion.keep_out.obstacles.distances(place) > room).all():
            return place


def smallest_room(motion, positions):
    return min(motion.keep_out.obstacles.distances(place).min() for place in positions)


def check_floor(settings, seeds, number=3):
    for seed in seeds:
        rng = np.random.default_rng(seed)
        motion = make_motion(MotionSettings(**settings), discs(rng), 0.1)
        height = 0.0 if settings['model'] == 'unicycle' else 1.0
        start = free_place(rng, motion, -0.2, 2.3, height)
        moved = [
            motion.keep_out.moved_out(start, np.append(rng.uniform(-0.2, 2.3, 2), height))
            for _ in range(number)
        ]
        goals = np.array([goal for goal in moved if goal is not None]).reshape(-1, 3)
        if not len(goals):
            continue
        state = RobotState.at_rest(start, float(rng.uniform(-3.0, 3.0)))
        prediction = motion.predict(state, goals, 0.05)
        centres = motion.keep_out.obstacles.centres[:, None, None, :2]
        offsets = prediction.positions[None, ..., :2] - centres
        gaps = np.sqrt((offsets**2).sum(axis=3))
        gaps -= motion.keep_out.obstacles.radii[:, None, None]
        assert gaps.min() >= 0.1, f'seed {seed}'
        assert prediction.reached.all(), f'seed {seed}'


@pytest.mark.parametrize('name', ROBOTS)
def test_no_robot_enters_an_obstacle(name):
    """1,000 random scenarios in all, 250 of each kind of robot."""
    check_floor(ROBOTS[name], range(250))


def test_dynamic_window_enters_no_obstacle():
    check_floor(WINDOW, range(40), number=1)


@pytest.mark.parametrize('model', ['constant_speed', 'mambo'])
def test_spheres_are_flown_around(model):
    for seed in range(60):
        rng = np.random.default_rng(seed)
        number = int(rng.integers(1, 8))
        obstacles = Obstacles(
            rng.uniform(20, 240, (number, 3)),
            rng.uniform(5, 40, number),
            np.ones(number, dtype=bool),
        )
        settings = MotionSettings(model=model, speed=4.0, tolerance=1.0, clearance=3.0)
        motion = make_motion(settings, obstacles, 1.0)
        start = free_place(rng, motion, 0.0, 260.0)
        goal = motion.keep_out.moved_out(start, rng.uniform(0.0, 260.0, 3))
        if goal is None:
            continue
        prediction = motion.predict(RobotState.at_rest(start), goal[None, :], 0.1)
        assert prediction.reached[0], f'seed {seed}'
        assert smallest_room(motion, prediction.positions[0]) >= 1.0, f'seed {seed}'


def test_trap_of_overlapping_discs():
    """A pocket open to the robot's side, with the waypoint behind it, is left and gone around."""
    centres = [[1.4, 0.6], [1.55, 0.8], [1.6, 1.0], [1.55, 1.2], [1.4, 1.4]]
    obstacles = Obstacles.from_settings(
        [Obstacle(centre=centre, radius=0.12) for centre in centres]
    )
    for settings in (*ROBOTS.values(), WINDOW):
        motion = make_motion(MotionSettings(**settings), obstacles, 0.08)
        prediction = motion.predict(RobotState.at_rest([1.2, 1.0, 0.0]), [[2.2, 1.0, 0.0]], 0.05)
        assert prediction.reached[0]
        assert smallest_room(motion, prediction.positions[0]) >= 0.08


def test_waypoint_in_an_obstacle_is_moved_towards_the_robot():
    """001, section 4.3: to the minimum admissible distance, on the line of robot and waypoint."""
    obstacles = Obstacles(np.array([[1.0, 1.0, 0.0]]), np.array([0.3]), np.array([False]))
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
    centres = np.array([[1.0, 0.0, 0.0], [1.0, 0.5, 0.0], [0.5, 0.25, 0.0], [1.5, 0.25, 0.0]])
    obstacles = Obstacles(centres, np.full(4, 0.24), np.zeros(4, dtype=bool))
    motion = make_motion(MotionSettings(model='unicycle', speed=0.2), obstacles, 0.1)
    prediction = motion.predict(RobotState.at_rest([-0.2, 0.25, 0.0]), [[1.0, 0.25, 0.0]], 0.05)
    assert not prediction.reached[0]
    assert smallest_room(motion, prediction.positions[0]) >= 0.1

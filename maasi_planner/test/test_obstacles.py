"""Ways around obstacles: nothing is ever touched, and everything is reached."""

import numpy as np
import pytest
import shapely

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_planner import MotionSettings, RobotState, make_motion
from maasi_planner.keep_out import KeepOut

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


def among(*rows):
    """Return an area with round obstacles: x, y, radius, or x, y, z, radius of a sphere."""
    zones = [{'centre': list(row[:-1]), 'radius': row[-1]} for row in rows]
    bounds = [[-1e3, 1e3]] * 3
    return Area(EnvironmentSettings.model_validate({'bounds': bounds, 'obstacles': zones}))


def discs(centres, radii):
    """Return cylinders with centres (n, 2) and radii, one for all or (n,)."""
    radii = np.broadcast_to(radii, len(centres))
    return among(*([*map(float, c), float(r)] for c, r in zip(centres, radii)))


def random_discs(rng):
    number = int(rng.integers(1, 7))
    return discs(rng.uniform(-0.1, 2.2, (number, 2)), rng.uniform(0.05, 0.3, number))


def random_spheres(rng):
    number = int(rng.integers(1, 8))
    centres, radii = rng.uniform(20, 240, (number, 3)), rng.uniform(5, 40, number)
    return among(*np.column_stack([centres, radii]).tolist())


def least_room(motion, prediction):
    places = prediction.positions.reshape(-1, 3)
    return min(motion.keep_out.area.distances(place).min() for place in places)


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
    while motion.keep_out.area.distances(start).min() <= radius + motion.settings.clearance:
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


def random_rooms(rng):
    """Return a polygon with a hole, and keep-outs that may touch each other and its border."""
    angles = 2.0 * np.pi * (np.arange(9) + rng.uniform(-0.3, 0.3, 9)) / 9
    rim = 40.0 * rng.uniform(0.6, 1.0, 9)[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
    hole = [[-4.0, -4.0], [4.0, -4.0], [0.0, 5.0]]
    keep_outs = []
    for _ in range(4):
        x, y = rng.uniform(-35.0, 35.0, 2).tolist()
        keep_outs.append([[x, y], [x + 8.0, y + 2.0], [x + 3.0, y + 9.0], [x + 4.0, y + 3.0]])
    keep_outs.append({'centre': rng.uniform(-30.0, 30.0, 2).tolist(), 'radius': 4.0})
    values = {'area': [rim.tolist(), hole], 'keep_outs': keep_outs}
    return Area(EnvironmentSettings.model_validate(values))


@pytest.mark.parametrize('settings', ROBOTS)
def test_no_robot_leaves_the_area_or_enters_a_keep_out(settings):
    rng = np.random.default_rng(3)
    reached = 0
    for _ in range(12):
        area = random_rooms(rng)
        scaled = settings | {'speed': 2.0, 'clearance': 0.5, 'tolerance': 0.3}
        motion = make_motion(MotionSettings(**scaled), area, 0.5)
        places = np.zeros((300, 3))
        places[:, :2] = rng.uniform(-40.0, 40.0, (300, 2))
        free = [place for place in places if motion.keep_out.is_free(place)]
        goals = [motion.keep_out.moved_out(free[0], place) for place in free[1:6]]
        goals = np.array([goal for goal in goals if goal is not None])
        prediction = motion.predict(RobotState.at_rest(free[0]), goals, 0.1)
        reached += prediction.reached.sum()
        for way in prediction.positions.reshape(-1, 3):
            point = shapely.Point(way[:2])
            assert area.region.covers(point) and area.region.boundary.distance(point) >= 0.5
    assert reached >= 50


def test_robot_in_a_keep_out_leaves_by_the_shortest_way():
    square = [[0.0, 0.0], [20.0, 0.0], [20.0, 20.0], [0.0, 20.0]]
    values = {'bounds': [[-50.0, 50.0]] * 2, 'keep_outs': [square]}
    area = Area(EnvironmentSettings.model_validate(values))
    motion = make_motion(MotionSettings(speed=2.0, clearance=0.5), area, 0.5)
    prediction = motion.predict(RobotState.at_rest([17.0, 9.0, 0.0]), [[-30.0, 9.0, 0.0]], 0.1)
    way = prediction.positions[0]
    assert prediction.reached[0]
    assert np.abs(way[:15, 1] - 9.0).max() < 1e-6 and way[15, 0] > 19.5
    out = ~area.region.covers(shapely.points(way[:, :2]))
    assert not out[np.argmin(out) :].any()


def test_robot_between_two_obstacles_has_no_way():
    obstacles = discs([[1.0, 0.0], [1.0, 0.5], [0.5, 0.25], [1.5, 0.25]], 0.24)
    motion = make_motion(MotionSettings(model='unicycle', speed=0.2), obstacles, 0.1)
    prediction = motion.predict(RobotState.at_rest([-0.2, 0.25, 0.0]), [[1.0, 0.25, 0.0]], 0.05)
    assert not prediction.reached[0]
    assert least_room(motion, prediction) >= 0.1

"""Teams: of robots that plan, of many in a field, and random ones in all situations."""

import numpy as np

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.models.detection import BoxDetection, ExponentialDetection, GaussianDetection
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner import (
    CandidateSet,
    CandidateSettings,
    MotionSettings,
    RobotState,
    RobotView,
    TeamView,
    make_motion,
)


def area_of(width, height, expected=12.0, **zones):
    values = {'bounds': [[0.0, width], [0.0, height]], 'expected_targets': expected, **zones}
    return Area(EnvironmentSettings.model_validate(values))


def planning_robot(start, detection, area=None, radius=0.1, candidates=(), **motion):
    """Return a robot that plans, with a measurement every five steps."""
    return RobotView(
        state=RobotState.at_rest([*start, 0.0][:3]),
        candidates=np.reshape(np.array(candidates, float), (-1, 3)),
        motion=make_motion(MotionSettings(**{'speed': 1.0} | motion), area, radius),
        sensor=Sensor('robot', detection, np.diag([0.1, 0.1]) ** 2),
        period_steps=5,
        radius=radius,
    )


def follow(team, name, robot, every=3):
    """Have a robot arrive as decided, with measurements every so many steps on the way."""
    view = team.robots[name]
    for place in robot.positions[::every]:
        team.exploration.update(view.sensor.detection, Pose.from_yaw(place, 0.0))
    view.state = RobotState.at_rest(robot.waypoint)


def field_team(number, side, candidates, corner=None, clusters=8, detection=None):
    """Return ranging drones with a swath of 20 m in a square that nobody has seen."""
    rng = np.random.default_rng(number)
    bounds = np.array([[0.0, side]] * 2)
    grid = CandidateSettings(grid=[candidates] * 2, spacing=side / candidates)
    detection = detection or BoxDetection([-10.0] * 2, [10.0] * 2, 0.95)
    motion = make_motion(MotionSettings(speed=5.0, tolerance=0.5))
    robots = {}
    for index in range(number):
        place = np.array([*rng.uniform(0.0, corner or side, 2), 10.0])
        robots[f'drone{index:03d}'] = RobotView(
            state=RobotState.at_rest(place),
            candidates=CandidateSet(grid, bounds, 10.0).at(place),
            motion=motion,
            sensor=Sensor('drone', detection, np.diag([1.0, 0.05]) ** 2),
            period_steps=10,
            radius=0.3,
        )
    spots = [rng.uniform(0.0, side, 2) for _ in range(clusters)]
    found = [Cluster(spot, 25.0 * np.eye(2), 5.0, 0.8) for spot in spots]
    return TeamView(0, 0.1, robots, found, UnexploredMap(bounds, max(4.0, side / 250.0)))


def random_team(
    rng,
    dimension=2,
    planning=2,
    waiting=1,
    candidates=5,
    kinds=('box', 'exponential', 'gaussian'),
    radius=0.0,
    spacing=None,
):
    size = 2.0 if dimension == 2 else 200.0
    bounds = np.array([[0.0, size]] * dimension)
    exploration = UnexploredMap(bounds, spacing or size / 9.7)
    exploration.values[...] = rng.uniform(size=exploration.values.shape)
    exploration.values[rng.uniform(size=exploration.values.shape) < 0.2] = 0.0

    def places(number):
        out = rng.uniform(0.0, size, size=(number, 3))
        if dimension == 2:
            out[:, 2] = 0.0
        return out

    clusters = []
    for place in places(int(rng.integers(1, 5))):
        root = 0.05 * size * rng.normal(size=(dimension, dimension))
        clusters.append(
            Cluster(
                place[:dimension],
                root @ root.T + 1e-4 * size**2 * np.eye(dimension),
                0.1,
                float(rng.uniform(0.1, 1.5)),
            )
        )
    robots = {}
    for index in range(planning + waiting):
        kind = kinds[int(rng.integers(len(kinds)))]
        if kind == 'box':
            low = -rng.uniform(0.05, 0.2, size=dimension) * size
            high = rng.uniform(0.05, 0.2, size=dimension) * size
            frame = 'robot' if rng.uniform() < 0.5 else 'world'
            gain = 0.9 if rng.uniform() < 0.5 else 1.0
            detection = BoxDetection(low.tolist(), high.tolist(), gain, frame)
        else:
            model = ExponentialDetection if kind == 'exponential' else GaussianDetection
            detection = model(0.98, (rng.uniform(0.05, 0.2, size=dimension) * size).tolist())
        noise = np.diag([0.01 * size, 0.1, 0.1][:dimension]) ** 2
        model = 'unicycle' if dimension == 2 and rng.uniform() < 0.5 else 'constant_speed'
        motion = make_motion(
            MotionSettings(
                model=model,
                speed=0.2 * size,
                tolerance=0.02 * size,
                heading='travel' if rng.uniform() < 0.5 else 'keep',
            )
        )
        state = RobotState.at_rest(places(1)[0], float(rng.uniform(-3.0, 3.0)))
        view = RobotView(
            state=state,
            candidates=places(candidates),
            motion=motion,
            sensor=Sensor(f'r{index}', detection, noise),
            period_steps=int(rng.integers(1, 7)),
            radius=radius * size,
        )
        if index >= planning:
            view.planning = False
            if rng.uniform() < 0.8:
                way = motion.predict(state, places(1), 0.1)
                end = int(way.lengths[0]) + 1
                skip = int(rng.integers(0, max(1, end // 2)))
                view.remaining_path = way.positions[0, skip:end].copy()
                view.remaining_yaws = way.yaws[0, skip:end].copy()
                view.phase = int(rng.integers(0, view.period_steps))
        robots[f'robot{rng.integers(1000):03d}_{index}'] = view
    return TeamView(7, 0.1, robots, clusters, exploration)

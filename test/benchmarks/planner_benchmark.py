"""Time of the planners' decisions: `run()` returns a list of figures.

Each figure is the median time of a whole decision, predicted trajectories included. Baselines are
measured in the same run: the same objective with e updated on the whole grid, as (21) is written.
"""

from __future__ import annotations

import numpy as np
from timing import entry, median_time

from maasi_filter.models.detection import ExponentialDetection
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner import (
    CandidateSet,
    CandidateSettings,
    MotionSettings,
    PlannerSettings,
    RobotState,
    RobotView,
    TeamView,
    make_motion,
    make_planner,
    warm_up,
)

CUBE = np.array([[0.0, 260.0]] * 3)
FLOOR = np.array([[-0.3, 2.4]] * 2)
PAPER = PlannerSettings(objective='paper', alpha=0.5, beta=0.5, control_weight=0.01)


def half_explored(bounds: np.ndarray, spacing: float, seed: int = 0) -> UnexploredMap:
    exploration = UnexploredMap(bounds, spacing)
    exploration.values[...] = np.random.default_rng(seed).uniform(size=exploration.values.shape)
    return exploration


def drones(number: int, model: str = 'constant_speed') -> TeamView:
    """Return ranging drones in the papers' cube that all plan now, 27 candidates each.

    They measure every 12 m, as in 000, section 5.1; the first one stands in the middle.
    """
    rng = np.random.default_rng(1)
    # 12 m/s, a measurement each second; the Mambo at 4 m/s every 3 s.
    speed, period = (12.0, 10) if model == 'constant_speed' else (4.0, 30)
    motion = make_motion(MotionSettings(model=model, speed=speed, tolerance=1.0))
    sensor = Sensor.ranging(
        'drone',
        ExponentialDetection(0.98, [25.0, 25.0, 25.0]),
        np.diag([1.5, 0.175, 0.295]) ** 2,
    )
    candidates = CandidateSet(
        CandidateSettings(grid=[3, 3, 3], spacing=120.0, corner=[10.0, 10.0, 10.0]), CUBE
    )
    robots = {}
    for index in range(number):
        place = np.array([120.0, 125.0, 118.0]) if index == 0 else rng.uniform(0.0, 260.0, 3)
        robots[f'drone{index}'] = RobotView(
            state=RobotState.at_rest(place),
            candidates=candidates.at(place),
            motion=motion,
            sensor=sensor,
            period_steps=period,
            radius=1.0,
        )
    clusters = [Cluster(rng.uniform(0.0, 260.0, 3), 25.0 * np.eye(3), 5.0, 0.8) for _ in range(6)]
    return TeamView(0, 0.1, robots, clusters, half_explored(CUBE, 10.0))


def floor_pair() -> TeamView:
    """Return Mambo and TurtleBot on the floor of 000, section 7.1.3: 9 and 64 candidates."""
    rng = np.random.default_rng(2)
    robots = {}
    for name, settings, size, noise, grid, place in (
        (
            'mambo',
            MotionSettings(model='mambo', speed=0.4),
            0.3,
            [0.016, 0.052],
            CandidateSettings(grid=[3, 3], spacing=0.6, corner=[0.1, 0.1]),
            [1.9, 1.9, 1.0],
        ),
        (
            'turtlebot',
            MotionSettings(model='unicycle', speed=0.2, yaw_rate=2.84, acceleration=2.5),
            0.15,
            [0.011, 0.0311],
            CandidateSettings(grid=[8, 8], spacing=0.25, corner=[0.0, 0.0]),
            [0.1, 0.1, 0.0],
        ),
    ):
        robots[name] = RobotView(
            state=RobotState.at_rest(place),
            candidates=CandidateSet(grid, FLOOR, place[2]).at(place),
            motion=make_motion(settings),
            sensor=Sensor.ranging(
                name, ExponentialDetection(0.98, [size, size]), np.diag(noise) ** 2
            ),
            period_steps=10,
            radius=0.1,
        )
    clusters = [Cluster(rng.uniform(0.0, 2.0, 2), 0.01 * np.eye(2), 0.1, 0.8) for _ in range(6)]
    return TeamView(0, 0.05, robots, clusters, half_explored(FLOOR, 0.1))


def whole_grid_decision(team: TeamView) -> int:
    """Decide for one robot with (17) to (22) as they are written, e on the whole grid."""
    name = team.planning()[0]
    view = team.robots[name]
    weights = PAPER.weights()
    prediction = view.motion.predict(view.state, view.candidates, team.step_time)
    centres = np.stack([cluster.position for cluster in team.clusters])
    values = []
    for w, length in enumerate(prediction.lengths):
        explored = team.exploration.copy()
        gain = 0.0
        for k in range(0, int(length), view.period_steps):
            pose = Pose.from_yaw(prediction.positions[w, k], prediction.yaws[w, k])
            explored.update(view.sensor.detection, pose)
            gain += weights.beta * float(explored.at(pose.position)[0])
            gain += weights.alpha * float(view.sensor.detection.probability(centres, pose).sum())
        cost = weights.control * prediction.control_cost[w]
        values.append((gain - cost) / max(int(length), 1))
    return int(np.argmax(values))


def run(share: float = 1.0) -> list[dict[str, object]]:
    warm_up()
    figures: list[dict[str, object]] = []

    def add(
        name: str,
        team: TeamView,
        repeats: int,
        settings: PlannerSettings = PAPER,
        baseline: str | None = None,
        against: float | None = None,
    ) -> None:
        planner = make_planner('maasi', settings)
        planner.decide(team)
        value = median_time(lambda: planner.decide(team), max(1, round(share * repeats)))
        ratio = None if against is None else against / value
        figures.append(entry(name, 1e3 * value, 'ms', baseline, ratio))

    single = drones(1)
    whole_grid_decision(single)
    whole = median_time(lambda: whole_grid_decision(single), 3)
    add('asi_decision', single, 200, baseline='e on the whole grid, h = 10 m', against=whole)
    add('asi_decision_mambo', drones(1, 'mambo'), 50)
    add('maasi_decision_pair', drones(2), 60)
    add('maasi_decision_mambo_turtlebot', floor_pair(), 60)
    add('maasi_decision_ten', drones(10), 20)
    information = PlannerSettings()
    add('asi_decision_information', single, 50, information)
    add('maasi_decision_pair_information', drones(2), 30, information)
    add('maasi_decision_mambo_turtlebot_information', floor_pair(), 30, information)
    return figures

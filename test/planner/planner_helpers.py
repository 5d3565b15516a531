"""A small search without targets or ROS: bodies, planner and exploration in one loop."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from maasi_filter.models.detection import BoxDetection, ExponentialDetection, GaussianDetection
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner import (
    CandidateSet,
    CandidateSettings,
    MotionSettings,
    Obstacles,
    RobotState,
    RobotView,
    TeamView,
    make_motion,
)

FLOOR = np.array([[-0.3, 2.4], [-0.3, 2.4]])
CUBE = np.array([[0.0, 260.0]] * 3)


@dataclass
class Member:
    """One robot of a small search."""

    motion: object
    body: object
    sensor: Sensor
    candidates: CandidateSet
    period: int
    radius: float = 0.0
    waypoint: np.ndarray | None = None
    remaining_path: np.ndarray | None = None
    remaining_yaws: np.ndarray | None = None
    since: int = 0
    idle: bool = False
    path: list = field(default_factory=list)

    def view(self, planning):
        """Return what the planner sees of it."""
        state = self.body.robot_state()
        return RobotView(
            state=state,
            candidates=self.candidates.at(state.pose.position),
            motion=self.motion,
            sensor=self.sensor,
            period_steps=self.period,
            planning=planning,
            remaining_path=None if planning or self.idle else self.remaining_path[self.since :],
            remaining_yaws=None if planning or self.idle else self.remaining_yaws[self.since :],
            phase=(-self.since) % self.period,
            radius=self.radius,
        )


class SmallSearch:
    """The closed loop of planner and bodies."""

    def __init__(self, planner, members, bounds, spacing, step_time, obstacles=None):
        self.planner = planner
        self.members = members
        self.exploration = UnexploredMap(bounds, spacing)
        self.step_time = step_time
        self.clusters: list[Cluster] = []
        self.obstacles = obstacles
        self.decisions = []
        self.measured = []
        self.step = 0

    def team(self, planning):
        """Return the view of the team."""
        return TeamView(
            self.step,
            self.step_time,
            {name: member.view(name in planning) for name, member in self.members.items()},
            self.clusters,
            self.exploration,
            obstacles=self.obstacles,
        )

    def run(self, limit):
        """Run until the planner has finished or for `limit` steps; return the reason, if any."""
        while self.step < limit:
            planning = [
                name
                for name, member in self.members.items()
                if not member.idle
                and (
                    member.waypoint is None
                    or member.motion.arrived(
                        member.body.robot_state().pose.position, member.waypoint
                    )
                    or member.since > 3 * len(member.remaining_path) + 100
                )
            ]
            if planning:
                decision = self.planner.decide(self.team(planning))
                self.decisions.append(decision)
                for name, robot in decision.robots.items():
                    member = self.members[name]
                    member.waypoint = robot.waypoint
                    member.remaining_path, member.remaining_yaws = robot.positions, robot.yaws
                    member.since = 0
                    member.idle = robot.stays
                reason = self.planner.finished(self.team([]))
                if reason is not None:
                    return reason
                if all(member.idle for member in self.members.values()):
                    return None
            for name in sorted(self.members):
                member = self.members[name]
                state = member.body.robot_state()
                member.path.append(state.pose.position)
                if member.since % member.period == 0 and not member.idle:
                    self.exploration.update(member.sensor.detection, state.pose)
                    self.measured.append((self.step, name, state.pose))
                if not member.idle:
                    member.body.step(member.motion.command(state, member.waypoint), self.step_time)
                member.since += 1
            self.step += 1
        return None


def floor_members(names=('mambo', 'turtlebot'), obstacles=None, paper=False):
    """Return the robots of 000, section 7.2, on the floor."""
    out = {}
    if 'mambo' in names:
        motion = make_motion(
            MotionSettings(model='mambo', speed=0.4, tolerance=0.05, approach_rate=1.3),
            obstacles,
            0.07 if obstacles else 0.0,
        )
        detection = BoxDetection([-0.2, -0.2], [0.2, 0.2])
        out['mambo'] = Member(
            motion,
            motion.body(RobotState.at_rest([1.9, 1.9, 1.0])),
            Sensor.ranging('mambo', detection, np.diag([0.016, 0.052]) ** 2),
            CandidateSet(
                CandidateSettings(grid=[7, 7], spacing=0.38, corner=[-0.09, -0.09]), FLOOR, 1.0
            ),
            10,
            0.07,
        )
    if 'turtlebot' in names:
        motion = make_motion(
            MotionSettings(
                model='unicycle', speed=0.2, yaw_rate=2.84, acceleration=2.5, tolerance=0.04
            ),
            obstacles,
            0.1 if obstacles else 0.0,
        )
        detection = BoxDetection([-0.1, -0.1], [0.2, 0.2])
        out['turtlebot'] = Member(
            motion,
            motion.body(RobotState.at_rest([0.0, 0.0, 0.0])),
            Sensor.ranging('turtlebot', detection, np.diag([0.011, 0.0311]) ** 2),
            CandidateSet(
                CandidateSettings(grid=[10, 10], spacing=0.25, corner=[-0.1, -0.1]), FLOOR
            ),
            10,
            0.1,
        )
    return out


def drone(start, speed=4.0, acceleration=None):
    """Return a ranging drone of 000, section 5.1."""
    motion = make_motion(
        MotionSettings(
            model='constant_speed', speed=speed, tolerance=1.0, acceleration=acceleration
        )
    )
    return Member(
        motion,
        motion.body(RobotState.at_rest(start)),
        Sensor.ranging(
            'drone',
            ExponentialDetection(0.98, [25.0, 25.0, 25.0]),
            np.diag([1.5, 0.175, 0.295]) ** 2,
        ),
        CandidateSet(
            CandidateSettings(grid=[3, 3, 3], spacing=120.0, corner=[10.0, 10.0, 10.0]), CUBE
        ),
        30,
        1.0,
    )


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
    """Return a team of random robots in all situations, with clusters and half-seen places."""
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
            sensor=Sensor.ranging(f'r{index}', detection, noise),
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


__all__ = [
    'CUBE',
    'FLOOR',
    'Member',
    'Obstacles',
    'SmallSearch',
    'drone',
    'floor_members',
    'random_team',
]

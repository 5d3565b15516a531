"""Input and output of a planner: view of the team, and decision."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_filter.geometry.area import Area
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.endurance import Endurance
from maasi_planner.motion.base import MotionModel, RobotState, Trajectories

# Reasons of robots that stay, by which the coordinator knows why.
#: It lets others pass.
CROSSED = 'waits: others are on its way'
#: It waits for its turn to charge.
TAKEN = 'all chargers are taken'
#: Others are in its way, for now.
BLOCKED = (
    'other robots are on all ways',
    'other robots stand at all candidates',
    'another robot is sent to every candidate',
    'another robot takes its candidates',
    TAKEN,
)
#: Nothing that is left is affordable.
SAVES_BATTERY = 'it has to save its battery for the path home'
#: Of a planner that gives it nothing; with a full battery there may be more.
NOTHING_LEFT = 'nothing is left for it'


@dataclass
class RobotView:
    """View of one robot at a step.

    Parameters
    ----------
    state : RobotState
        Present pose and velocity.
    candidates : (W, 3) array
        Waypoints to choose from, metres, frame `map`; used when `planning`.
    motion : MotionModel
        Predicts trajectories; knows where it may go.
    sensor : Sensor
        With its probability of detection and noise.
    period_steps : int
        Steps between possible measurements, Delta.
    planning : bool
        Whether the robot is in P_k: it chooses a waypoint now.
    remaining_path : (n, 3) array, optional
        Remaining trajectory of a robot that is not planning: positions at steps now, now + 1 and
        so on. None: it stands at its present position.
    remaining_yaws : (n,) array, optional
        Headings along the remaining path, radians. None: the present one.
    phase : int
        Steps from now to the next possible measurement of a robot that is not planning. (One
        that plans measures now.)
    radius : float
        Radius of a circle around the robot, metres; separates waypoints of different robots.
    endurance : Endurance, optional
        What its battery allows. None: everything.
    arrival_radius : float
        Distance from its waypoint at which the robot takes its next decision, metres.
    exploration : UnexploredMap, optional
        e after the robot's own measurements only, iota of 002, eq. (12). None: that of the team.
    """

    state: RobotState
    candidates: FloatArray
    motion: MotionModel
    sensor: Sensor
    period_steps: int
    planning: bool = True
    remaining_path: FloatArray | None = None
    remaining_yaws: FloatArray | None = None
    phase: int = 0
    radius: float = 0.0
    endurance: Endurance | None = None
    arrival_radius: float = 0.0
    exploration: UnexploredMap | None = None

    def __post_init__(self) -> None:
        if self.period_steps < 1:
            raise ValueError(f'period_steps: got {self.period_steps}, allowed are integers from 1')
        if not 0.0 <= self.radius < math.inf:
            raise ValueError(f'radius: got {self.radius}, allowed are finite numbers from 0 [m]')
        for name in ('candidates', 'remaining_path'):
            shape = np.shape(getattr(self, name))
            if shape and (len(shape) != 2 or shape[1] != 3):
                raise ValueError(f'{name}: got shape {shape}, allowed is (n, 3)')

    @property
    def height(self) -> float:
        """Height of its waypoints in a planar search, metres: its own without candidates."""
        known = self.candidates[0] if len(self.candidates) else self.state.pose.position
        return float(known[2])


@dataclass
class TeamView:
    """View of the whole team at one step.

    Parameters
    ----------
    step : int
        k.
    step_time : float
        Seconds per step.
    robots : dict
        By name; always processed in the order of names.
    clusters : list of Cluster
        Potential targets now.
    exploration : UnexploredMap
        e after the last measurements.
    taken : sequence of (3,) array and float
        Present or final positions of robots of other planners, metres, and their radii.
    """

    step: int
    step_time: float
    robots: dict[str, RobotView]
    clusters: list[Cluster]
    exploration: UnexploredMap
    taken: Sequence[tuple[FloatArray, float]] = ()

    def __post_init__(self) -> None:
        if not 0.0 < self.step_time < math.inf:
            raise ValueError(f'step_time: got {self.step_time}, allowed are numbers above 0 [s]')

    @property
    def area(self) -> Area:
        """Where targets may be and robots may go."""
        return self.exploration.area

    @property
    def bounds(self) -> FloatArray:
        """Bounds of the environment, (d, 2), metres."""
        return self.exploration.bounds

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.exploration.dimension

    def names(self) -> list[str]:
        """Return the names of all robots in order."""
        return sorted(self.robots)

    def planning(self) -> list[str]:
        """Return the names of the robots that plan now, in order."""
        return [name for name in self.names() if self.robots[name].planning]


@dataclass
class UsableCandidates:
    """Candidates of one planning robot.

    points (W, 3): waypoints, moved out of obstacles, metres; prediction: to them; allowed (W,):
    which are reachable, not the present place, and apart from where others will stand.
    """

    points: FloatArray
    prediction: Trajectories
    allowed: BoolArray


@dataclass
class RobotDecision:
    """Decision for one robot, with all compared candidates.

    Attributes
    ----------
    chosen : int
        Index into `candidates`; -1 means stay where it is (see `reason`).
    waypoint : (3,) array
        Chosen waypoint, metres, frame `map`; the present position when it stays.
    positions, yaws : (K + 1, 3), (K + 1,) arrays
        Predicted trajectory, from the present state.
    candidates : (W, 3) array
        Waypoints that were compared, after moving them out of obstacles.
    control_cost, target_refinement, exploration, objective : (W,) arrays
        C, T, E and J of each, given the choices of the other robots; J is -inf for inadmissible
        candidates. With the objective `information`, T and E of the chosen ones sum to those of
        the team. In very large teams T, E and J of other candidates neglect the other planning
        robots.
    lengths, measurements : (W,) integer arrays
        Steps K and measurements M of each predicted trajectory.
    reason : str
        Explanation of the choice.
    tour : (n, 3) array
        Places where it is to go after the waypoint, of planners that plan so far.
    """

    chosen: int
    waypoint: FloatArray
    positions: FloatArray
    yaws: FloatArray
    candidates: FloatArray
    control_cost: FloatArray
    target_refinement: FloatArray
    exploration: FloatArray
    objective: FloatArray
    lengths: IntArray
    measurements: IntArray
    reason: str
    tour: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def stays(self) -> bool:
        """Whether the robot stays at its present position."""
        return self.chosen < 0

    @property
    def blocked(self) -> bool:
        """Whether it stays as others are in its way."""
        return self.stays and any(text in self.reason for text in (CROSSED, *BLOCKED))

    @property
    def saves_battery(self) -> bool:
        """Whether it stays as nothing that is left is affordable."""
        return self.stays and SAVES_BATTERY in self.reason

    @property
    def unaffordable(self) -> bool:
        """Whether it stays, and a better charged battery may help."""
        return self.stays and any(text in self.reason for text in (SAVES_BATTERY, NOTHING_LEFT))

    @property
    def length(self) -> int:
        """Steps of the chosen trajectory."""
        return len(self.positions) - 1


@dataclass
class Decision:
    """Joint decision of a planner for all robots that plan."""

    step: int
    robots: dict[str, RobotDecision] = field(default_factory=dict)
    objective: float = 0.0
    exact: bool = True
    evaluated: int = 0
    reason: str = ''


def single_choice(
    points: FloatArray, prediction: Trajectories, chosen: int, reason: str
) -> RobotDecision:
    """Return a decision without the terms of J, for planners that do not use it."""
    length = int(prediction.lengths[chosen])
    return RobotDecision(
        chosen=chosen,
        waypoint=points[chosen].copy(),
        positions=prediction.positions[chosen, : length + 1].copy(),
        yaws=prediction.yaws[chosen, : length + 1].copy(),
        candidates=points,
        control_cost=prediction.control_cost,
        target_refinement=np.zeros(len(points)),
        exploration=np.zeros(len(points)),
        objective=np.zeros(len(points)),
        lengths=prediction.lengths,
        measurements=np.zeros(len(points), np.int64),
        reason=reason,
    )


def stay(view: RobotView, reason: str) -> RobotDecision:
    """Return the decision to stay, the safe fallback without usable candidates."""
    empty = np.zeros(0)
    return RobotDecision(
        chosen=-1,
        waypoint=np.array(view.state.pose.position),
        positions=np.array(view.state.pose.position)[None, :],
        yaws=np.array([view.state.pose.yaw]),
        candidates=np.zeros((0, 3)),
        control_cost=empty,
        target_refinement=empty,
        exploration=empty,
        objective=empty,
        lengths=np.zeros(0, np.int64),
        measurements=np.zeros(0, np.int64),
        reason=reason,
    )

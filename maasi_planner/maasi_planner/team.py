"""Input and output of planners: view of the team, and decisions."""

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

# Reasons to stay, which the coordinator recognises.
#: The robot lets others pass.
CROSSED = 'waits: other robots are in its path'
#: The robot waits for a charger.
TAKEN = 'all chargers are taken'
#: Other robots take all its candidates at the same step.
ASSIGNED = 'every candidate is assigned to another robot'
#: Other robots block the robot for now.
BLOCKED = (
    'other robots block all paths',
    'other robots occupy all candidates',
    ASSIGNED,
    TAKEN,
)
#: The robot can afford nothing that remains.
SAVES_BATTERY = 'its charge is needed for the path home'
#: The planner has nothing for the robot, at least with its present charge.
NOTHING_LEFT = 'no remaining position is worth a visit'


@dataclass
class RobotView:
    """One robot at a step.

    Parameters
    ----------
    state : RobotState
        Present pose and velocity.
    candidates : (W, 3) array
        Waypoints to choose from, metres, frame `map`; used when `planning`.
    motion : MotionModel
        Predicts trajectories.
    sensor : Sensor
        Probability of detection and noise.
    period_steps : int
        Delta, steps from one possible measurement to the next.
    planning : bool
        Whether the robot is in P_k and needs a waypoint now.
    remaining_path : (n, 3) array, optional
        Remaining trajectory of a robot that is not planning, metres, frame `map`: positions at
        this step and the following ones. None: the robot stands.
    remaining_yaws : (n,) array, optional
        Headings along the remaining path, radians. None: the present one.
    phase : int
        Steps to the next possible measurement of a robot that is not planning. (A planning robot
        measures now.)
    radius : float
        Radius of a circle around the robot, metres, which keeps waypoints of robots apart.
    endurance : Endurance, optional
        Battery. None: unlimited.
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
    def underway(self) -> bool:
        """Whether it still has a path to follow."""
        return self.remaining_path is not None and len(self.remaining_path) > 1

    @property
    def destination(self) -> FloatArray:
        """Where its path ends or, without one, where it is, (3,) [m]."""
        path = None if self.planning else self.remaining_path
        return path[-1] if path is not None and len(path) else self.state.pose.position

    @property
    def height(self) -> float:
        """Height of its waypoints in 2D, metres; without candidates that of the robot."""
        known = self.candidates[0] if len(self.candidates) else self.state.pose.position
        return float(known[2])


@dataclass
class TeamView:
    """The whole team at one step.

    Parameters
    ----------
    step : int
        k.
    step_time : float
        Seconds per step.
    robots : dict
        Robots by name; always processed in the order of names.
    clusters : list of Cluster
        Potential targets.
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
        """Search area."""
        return self.exploration.area

    @property
    def bounds(self) -> FloatArray:
        """Bounding box of the area, (d, 2), metres."""
        return self.exploration.bounds

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.exploration.dimension

    def names(self) -> list[str]:
        """Return the names of all robots in order."""
        return sorted(self.robots)

    def planning(self) -> list[str]:
        """Return the names of the planning robots in order."""
        return [name for name in self.names() if self.robots[name].planning]


@dataclass
class UsableCandidates:
    """Candidates of one planning robot.

    Attributes
    ----------
    points : (W, 3) array
        Waypoints, moved out of obstacles [m, map].
    prediction : Trajectories
        Predicted trajectories to them.
    allowed : (W,) array of bool
        Which are reachable with the battery, other than the present position, and clear of the
        other robots.
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
        Index into `candidates`; -1: the robot stays (see `reason`).
    waypoint : (3,) array
        Chosen waypoint, metres, frame `map`; the present position if the robot stays.
    positions, yaws : (K + 1, 3), (K + 1,) arrays
        Predicted trajectory from the present state, metres and radians.
    candidates : (W, 3) array
        Compared waypoints, moved out of obstacles.
    control_cost, target_refinement, exploration, objective : (W,) arrays
        C, T, E and J of each, given the choices of the other robots; J is -inf for inadmissible
        candidates. With the objective `information`, T and E of the chosen ones sum to those of
        the team. In very large teams, T, E and J of other candidates neglect the other planning
        robots.
    lengths, measurements : (W,) integer arrays
        Steps K and measurements M of each predicted trajectory.
    reason : str
        Explanation of the choice.
    tour : (n, 3) array
        Positions to visit after the waypoint, metres, if the planner plans that far.
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
        """Whether the robot stays as others block it."""
        return self.stays and any(text in self.reason for text in (CROSSED, *BLOCKED))

    @property
    def saves_battery(self) -> bool:
        """Whether the robot stays as it can afford nothing that remains."""
        return self.stays and SAVES_BATTERY in self.reason

    @property
    def unaffordable(self) -> bool:
        """Whether the robot stays, and a fuller battery may help."""
        return self.stays and any(text in self.reason for text in (SAVES_BATTERY, NOTHING_LEFT))

    @property
    def length(self) -> int:
        """Steps of the chosen trajectory."""
        return len(self.positions) - 1


@dataclass
class Decision:
    """Joint decision for all planning robots.

    Attributes
    ----------
    step : int
        Step k at which it was made.
    robots : dict of RobotDecision
        Decision of each planning robot, by name.
    objective : float
        J of the chosen joint candidate.
    exact : bool
        Whether all joint candidates were compared.
    evaluated : int
        Number of joint candidates that were evaluated.
    reason : str
        Why, for log and page.
    """

    step: int
    robots: dict[str, RobotDecision] = field(default_factory=dict)
    objective: float = 0.0
    exact: bool = True
    evaluated: int = 0
    reason: str = ''


def single_choice(
    points: FloatArray, prediction: Trajectories, chosen: int, reason: str
) -> RobotDecision:
    """Return the decision for a candidate, without the terms of J.

    Parameters
    ----------
    points : (W, 3) array
        Candidates [m, map].
    prediction : Trajectories
        Their predicted trajectories.
    chosen : int
        Index of the chosen candidate.
    reason : str
        Why, for log and page.

    Returns
    -------
    RobotDecision
    """
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
    """Return the decision to stay.

    Parameters
    ----------
    view : RobotView
        The robot.
    reason : str
        Why, for log and page.

    Returns
    -------
    RobotDecision
    """
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

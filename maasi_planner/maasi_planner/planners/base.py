"""Interface of the planners, and the choice of usable candidates."""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel

from maasi_filter.area import Area
from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.plugins import PluginError
from maasi_filter.records import Cluster
from maasi_planner.motion.base import Trajectories
from maasi_planner.planners.separation import apart as apart
from maasi_planner.planners.separation import free_of_robots as free_of_robots
from maasi_planner.planners.separation import ways_apart
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import (
    BLOCKED,
    SAVES_BATTERY,
    Decision,
    RobotDecision,
    RobotView,
    TeamView,
    UsableCandidates,
    stay,
)
from maasi_planner.team import (
    CROSSED as CROSSED,
)


class Planner(ABC):
    """Decides where the robots that plan at a step go next.

    Parameters
    ----------
    settings : PlannerSettings
        Which planner, and its numbers.

    Attributes
    ----------
    measures_underway : bool
        Whether robots measure on their way, or only at their waypoints.
    Settings : type or None
        Model of the planner's own settings; with it, `settings.settings` is an instance.
    own : BaseModel or None
        That instance.
    """

    measures_underway = True
    Settings: ClassVar[type[BaseModel] | None] = None

    def __init__(self, settings: PlannerSettings) -> None:
        self.settings = settings

    @property
    def own(self) -> Any:
        """The planner's own settings."""
        return self.settings.settings

    def take_settings(self, settings: PlannerSettings) -> None:
        """Take other numbers while it plans; they are used from its next decision on."""
        self.settings = settings

    @abstractmethod
    def decide(self, team: TeamView) -> Decision:
        """Return a decision for every robot in the team that plans.

        A robot for which nothing is admissible is told to stay, with the reason.
        """

    def finished(self, team: TeamView) -> str | None:
        """Return why nothing is left to gain, or None while something is.

        That is when the environment is explored to `explored_threshold` and no cluster with a
        mass of `mass_threshold` or more is left.
        """
        explored = team.exploration.explored_fraction()
        if explored < self.settings.explored_threshold:
            return None
        return self._settled(team, f'{100.0 * explored:.1f} % of the environment is explored')

    def searching(self, team: TeamView) -> list[str]:
        """Return the names of the robots that still search, in order: not those that are done."""
        views = team.robots
        return [
            name
            for name in team.names()
            if (endurance := views[name].endurance) is None or not endurance.done_reason
        ]

    def _settled(self, team: TeamView, reason: str) -> str | None:
        return None if self.heavy(team) else f'{reason} and no potential target is left'

    def heavy(self, team: TeamView) -> list[Cluster]:
        """Return the clusters that are worth a visit."""
        least = self.settings.mass_threshold
        return [cluster for cluster in team.clusters if cluster.mass >= least]


def check_decision(planner: Planner, team: TeamView, decision: Decision) -> None:
    """Refuse a decision that robots cannot follow."""
    origin = f'planner {type(planner).__module__}:{type(planner).__qualname__}'
    if not (isinstance(decision, Decision) and isinstance(decision.robots, dict)):
        raise PluginError(f'{origin}: decide returned {decision!r:.80}, allowed is a Decision')
    if set(decision.robots) != set(team.planning()):
        raise PluginError(
            f'{origin}: decided for {sorted(map(str, decision.robots))}, allowed are exactly the '
            f'robots that plan, {team.planning()}'
        )
    for name, robot in decision.robots.items():
        if not isinstance(robot, RobotDecision):
            raise PluginError(f'{origin}: {name}: got {robot!r:.80}, allowed is a RobotDecision')
        problem = _problem_of(robot, team.area)
        if problem:
            raise PluginError(f'{origin}: {name}: {problem}')


def _problem_of(robot: RobotDecision, area: Area) -> str:
    """Return what is wrong with a decision for one robot; empty if nothing is."""
    terms = ('control_cost', 'target_refinement', 'exploration', 'objective')
    rows, steps = np.shape(robot.candidates)[:1], np.shape(robot.positions)[:1]
    shapes = {'waypoint': (3,), 'positions': (*steps, 3), 'yaws': steps, 'candidates': (*rows, 3)}
    shapes['tour'] = (*np.shape(robot.tour)[:1], 3)
    shapes |= dict.fromkeys((*terms, 'lengths', 'measurements'), rows)
    for field, shape in shapes.items():
        value = getattr(robot, field)
        if not (isinstance(value, np.ndarray) and value.dtype.kind in 'if'):
            return f'{field}: got {value!r:.80}, allowed is an array of numbers'
        if value.shape != shape:
            return f'{field}: got shape {value.shape}, allowed is {shape}'
        if field not in terms and not np.isfinite(value).all():
            return f'{field}: got a number that is not finite'
    if not (isinstance(robot.chosen, int | np.integer) and -1 <= robot.chosen < rows[0]):
        return f'chosen: got {robot.chosen!r:.80}, allowed are -1 (stay) to {rows[0] - 1}'
    if not robot.stays and not area.inside(robot.waypoint[None, :]).all():
        allowed = f'inside {area.bounds.tolist()} [m], and inside the area'
        return f'waypoint: got {robot.waypoint.tolist()}, allowed is {allowed}'
    return ''


def usable_candidates(
    team: TeamView, name: str, extra: FloatArray | None = None
) -> tuple[FloatArray, str]:
    """Return a robot's candidates moved out of obstacles, and which were dropped."""
    view = team.robots[name]
    points = np.asarray(view.candidates, dtype=float).reshape(-1, 3)
    dropped: list[str] = []
    inside = team.area.inside(points)
    if not inside.all():
        finite = np.isfinite(points).all(axis=1)
        for wrong, reason in ((~finite, 'not finite'), (finite & ~inside, 'outside the area')):
            if wrong.any():
                dropped.append(f'{np.count_nonzero(wrong)} {reason}')
        points = points[inside]
    number = len(points)
    if extra is not None and len(extra):
        points = np.vstack([points, extra[team.area.inside(extra)]])
    if len(view.motion.keep_out):
        here = view.state.pose.position
        moved = [view.motion.keep_out.moved_out(here, point) for point in points]
        lost = sum(point is None for point in moved[:number])
        if lost:
            dropped.append(f'{lost} in obstacles')
        points = np.array([point for point in moved if point is not None]).reshape(-1, 3)
        # They move towards the robot, which may be outside.
        points = points[team.area.inside(points)]
    return points, ', '.join(dropped)


def waiting_places(team: TeamView) -> list[tuple[FloatArray, float]]:
    """Return where robots that do not plan will stand, with their radii."""
    places = list(team.taken)
    for name in team.names():
        view = team.robots[name]
        if view.planning:
            continue
        if view.remaining_path is not None and len(view.remaining_path):
            place = np.asarray(view.remaining_path[-1], dtype=float)
        else:
            place = np.array(view.state.pose.position)
        places.append((place, view.radius))
    return places


def options_of(
    team: TeamView,
    name: str,
    places: list[tuple[FloatArray, float]],
    extra: FloatArray | None = None,
) -> UsableCandidates | str:
    """Return the candidates of a robot, or why it has to stay."""
    view = team.robots[name]
    if not len(view.candidates) and (extra is None or not len(extra)):
        return 'it has no candidates'
    points, dropped = usable_candidates(team, name, extra)
    if not len(points):
        return f'no candidate is usable ({dropped})'
    prediction = view.motion.predict(view.state, points, team.step_time)
    free = free_of_robots(points, view.radius, places)
    allowed = prediction.reached & free & (prediction.lengths > 0)
    if allowed.any():
        allowed &= ways_apart(team, name, prediction.positions, {})
        if not allowed.any():
            return BLOCKED[0]
        allowed = affordable(team, name, prediction, allowed)
        if not allowed.any():
            return SAVES_BATTERY
        return UsableCandidates(points, prediction, allowed)
    if not free.any():
        return BLOCKED[1]
    if (prediction.lengths == 0).any():
        return 'it is at its only candidate already'
    return 'no candidate can be reached'


def usable_options(
    team: TeamView,
    decision: Decision,
    extra: Callable[[str], FloatArray | None] = lambda _: None,
    kept: Callable[[str, Trajectories], Trajectories] = lambda _, exact: exact,
) -> dict[str, UsableCandidates]:
    """Return the candidates of the robots that have some; the others stay in `decision`.

    extra: further waypoints (n, 3) of a robot; kept: what is kept of its predicted trajectories.
    """
    places = waiting_places(team)
    options = {}
    for name in team.planning():
        found = options_of(team, name, places, extra(name))
        if isinstance(found, str):
            decision.robots[name] = stay(team.robots[name], f'stays: {found}')
        else:
            options[name] = replace(found, prediction=kept(name, found.prediction))
    return options


def centres_of(team: TeamView, view: RobotView, clusters: Sequence[Cluster]) -> FloatArray:
    """Return the centres of clusters as waypoints (n, 3); in 2D at the robot's height."""
    centres = np.zeros((len(clusters), 3))
    centres[:, 2] = view.height
    for row, cluster in zip(centres, clusters):
        row[: team.dimension] = cluster.position[: team.dimension]
    return centres


def affordable(
    team: TeamView, name: str, prediction: Trajectories, allowed: BoolArray
) -> BoolArray:
    """Return which of the allowed ways leave a robot enough of its battery to come home, (W,)."""
    endurance = team.robots[name].endurance
    if endurance is None:
        return allowed
    return allowed & endurance.affords(prediction, team.step_time)


def crossed(team: TeamView, name: str, prediction: Trajectories, decision: Decision) -> bool:
    """Return whether others, also those just decided, are on the only way of a prediction."""
    others = {key: robot.positions for key, robot in decision.robots.items()}
    return not ways_apart(team, name, prediction.positions, others)[0]


def held_back(team: TeamView, name: str, prediction: Trajectories, decision: Decision) -> str:
    """Return why a robot must not go the only way of a prediction now, or an empty text."""
    if crossed(team, name, prediction, decision):
        return CROSSED
    if not affordable(team, name, prediction, prediction.reached)[0]:
        return f'stays: {SAVES_BATTERY}'
    return ''


def all_apart(team: TeamView, waypoints: Mapping[str, FloatArray]) -> bool:
    """Return whether the waypoints (3,) of robots, by name, keep their radii apart."""
    taken: list[tuple[FloatArray, float]] = []
    for name, point in waypoints.items():
        radius = team.robots[name].radius
        if not apart(point, radius, taken):
            return False
        taken.append((point, radius))
    return True


def explain(decision: Decision) -> Decision:
    """Sort the robots by name and join their reasons."""
    decision.robots = {name: decision.robots[name] for name in sorted(decision.robots)}
    decision.reason = '; '.join(
        f'{name}: {robot.reason}' for name, robot in decision.robots.items()
    )
    return decision


def search_jointly(
    team: TeamView,
    settings: PlannerSettings,
    indices: Mapping[str, Sequence[int]],
    points: Mapping[str, FloatArray],
    value: Callable[[dict[str, int]], float],
    margin: float = 0.0,
) -> tuple[dict[str, int], float, bool, int]:
    """Return the best joint choice, its value, whether it is exact, and choices evaluated.

    All joint choices of `indices` into the waypoints are compared, or above the limit robots choose
    in turn and improve in rounds. One is better by more than `margin`; -1: none is admissible.
    """
    best: dict[str, int] = dict.fromkeys(indices, -1)
    best_value, evaluated = -math.inf, 0

    def fits(joint: dict[str, int]) -> bool:
        places = {name: points[name][row] for name, row in joint.items() if row >= 0}
        return all_apart(team, places)

    if math.prod(map(len, indices.values())) <= settings.enumeration_limit:
        for rows in itertools.product(*indices.values()):
            joint = dict(zip(indices, rows))
            if fits(joint):
                evaluated += 1
                total = value(joint)
                if total > best_value + margin:
                    best, best_value = joint, total
        if best_value > -math.inf:
            return best, best_value, True, evaluated
    for _ in range(1 + settings.improvement_rounds):
        before = dict(best)
        for name in indices:
            own, own_value = -1, -math.inf
            for row in indices[name]:
                joint = {**best, name: row}
                if fits(joint):
                    evaluated += 1
                    total = value(joint)
                    if total > own_value + margin:
                        own, own_value = row, total
            best[name], best_value = own, max(own_value, best_value)
        if best == before:
            break
    return best, best_value, False, evaluated

"""Interface of the planners, and the check of their decisions."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel

from maasi_filter.geometry.area import Area
from maasi_filter.plugins import PluginError
from maasi_filter.records import Cluster
from maasi_planner.planners.options import options_of as options_of
from maasi_planner.planners.options import waiting_places as waiting_places
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import Decision, RobotDecision, TeamView


class Planner(ABC):
    """Decides the next waypoints of the robots that plan at a step.

    Parameters
    ----------
    settings : PlannerSettings
        Name and parameters of the planner.

    Attributes
    ----------
    measures_underway : bool
        Whether robots measure on their path, or only at their waypoints.
    keys : type
        Settings model of the keys under `planner`.
    Settings : type or None
        Model of a plugin's own settings, of which `settings.settings` is an instance.
    own : BaseModel or None
        That instance.
    """

    measures_underway = True
    keys: ClassVar[type[PlannerSettings]] = PlannerSettings
    prefix = ''  # of the reasons of its decisions
    Settings: ClassVar[type[BaseModel] | None] = None

    def __init__(self, settings: PlannerSettings) -> None:
        self.settings = settings

    @property
    def own(self) -> Any:
        """The plugin's own settings."""
        return self.settings.settings

    @abstractmethod
    def decide(self, team: TeamView) -> Decision:
        """Return a decision for every planning robot; one without an admissible waypoint stays.

        Parameters
        ----------
        team : TeamView
            The team at this step: positions in metres, frame `map`.

        Returns
        -------
        Decision
            With a `RobotDecision` for exactly the robots of `team.planning()`, which
            `single_choice` and `stay` make. Waypoints lie inside the area.
        """

    def finished(self, team: TeamView) -> str | None:
        """Return why the search has ended, or None.

        It ends when `explored_threshold` of the area is explored and no cluster has a mass of
        `mass_threshold` or more.

        Parameters
        ----------
        team : TeamView
            The team at this step.

        Returns
        -------
        str or None
            The reason, for log and report.
        """
        if team.exploration.explored_fraction() < self.settings.explored_threshold:
            return None
        return self._settled(team, team.exploration.describe())

    def searching(self, team: TeamView) -> list[str]:
        """Return the names of the robots that continue to search, in order."""
        views = team.robots
        return [
            name
            for name in team.names()
            if (endurance := views[name].endurance) is None or not endurance.done_reason
        ]

    def _settled(self, team: TeamView, reason: str) -> str | None:
        return None if self.heavy(team) else f'{reason} and no potential target remains'

    def heavy(self, team: TeamView) -> list[Cluster]:
        """Return the clusters that are worth a visit."""
        least = self.settings.mass_threshold
        return [cluster for cluster in team.clusters if cluster.mass >= least]


def check_decision(planner: Planner, team: TeamView, decision: Decision) -> None:
    """Raise PluginError for a decision that robots cannot follow."""
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


def explain(decision: Decision) -> Decision:
    """Sort the robots by name and join their reasons."""
    decision.robots = {name: decision.robots[name] for name in sorted(decision.robots)}
    decision.reason = '; '.join(
        f'{name}: {robot.reason}' for name, robot in decision.robots.items()
    )
    return decision

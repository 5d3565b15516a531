"""The default: `tour` or `maasi`, by the size of the area in what robots see on passing."""

from maasi_planner.planners.base import Planner
from maasi_planner.planners.intermittent import Intermittent
from maasi_planner.planners.lattice import lanes_of
from maasi_planner.planners.tour import Tour
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import Decision, TeamView

SQUARES = 30


class Auto(Planner):
    """Plans with `tour` in areas of 30 squares of a swath or more, else with `maasi`.

    Squares are those of `tour`; docs/search_quality.md has the measurements that the rule is from.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        super().__init__(settings)
        self._chosen: Planner | None = None

    def take_settings(self, settings: PlannerSettings) -> None:
        """See `Planner.take_settings`; also of the planner that it has chosen."""
        super().take_settings(settings)
        if self._chosen is not None:
            self._chosen.take_settings(settings.renamed(self._chosen.settings.name))

    def decide(self, team: TeamView) -> Decision:
        """See `Planner.decide`."""
        planner = self._choice(team)
        decision = planner.decide(team)
        decision.reason = f'{planner.settings.name}: {decision.reason}'
        return decision

    def finished(self, team: TeamView) -> str | None:
        """See `Planner.finished`."""
        return self._choice(team).finished(team)

    def _choice(self, team: TeamView) -> Planner:
        if self._chosen is None:
            many = team.exploration.volume >= SQUARES * lanes_of(team)[0] ** team.dimension
            settings = self.settings.renamed('tour' if many else 'maasi')
            self._chosen = Tour(settings) if many else Intermittent(settings)
        return self._chosen

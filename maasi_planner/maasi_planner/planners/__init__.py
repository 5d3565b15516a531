"""Planners by name."""

from maasi_planner.planners.active_search import ActiveSearch
from maasi_planner.planners.base import Planner
from maasi_planner.planners.intermittent import Intermittent
from maasi_planner.planners.lattice import lanes_of
from maasi_planner.planners.lawnmower import Lawnmower
from maasi_planner.planners.mutual_information import MutualInformation
from maasi_planner.planners.nearest_widest import NearestWidest
from maasi_planner.settings import PLANNERS, PlannerSettings, planner_settings
from maasi_planner.team import TeamView

__all__ = [
    'ActiveSearch',
    'Intermittent',
    'Lawnmower',
    'MutualInformation',
    'NearestWidest',
    'Planner',
    'make_planner',
    'takes_tour',
]


def takes_tour(volume: float, width: float, dimension: int) -> bool:
    """Return whether `auto` is `tour` rather than `maasi`, by volume and width of view [m].

    docs/search_quality.md has the measurements behind this rule.
    """
    return volume >= 30 * width**dimension


def make_planner(
    name: str, settings: PlannerSettings | None = None, team: TeamView | None = None
) -> Planner:
    """Return the planner called `name`.

    Parameters
    ----------
    name : str
        As in `PlannerSettings.name`.
    settings : PlannerSettings, optional
        Its settings, whose name `name` replaces.
    team : TeamView, optional
        The team at the first decision, by which `auto` becomes `tour` or `maasi`.

    Raises
    ------
    ValueError
        If the name is unknown, its settings are wrong, or `auto` has no team.
    """
    own = planner_settings(name) if settings is None else settings.renamed(name)
    if name != 'auto':
        planner: Planner = PLANNERS.load(name)(own)
        return planner
    if team is None:
        raise ValueError('planner auto: got no team, allowed is the team to choose a planner for')
    many = takes_tour(team.exploration.volume, lanes_of(team)[0], team.dimension)
    chosen = 'tour' if many else 'maasi'
    planner = PLANNERS.load(chosen)(own)
    planner.prefix = f'{chosen}: '
    return planner

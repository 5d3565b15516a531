"""Planners by name."""

from maasi_planner.planners.active_search import ActiveSearch
from maasi_planner.planners.base import Planner
from maasi_planner.planners.intermittent import Intermittent
from maasi_planner.planners.lawnmower import Lawnmower
from maasi_planner.planners.mutual_information import MutualInformation
from maasi_planner.planners.nearest_widest import NearestWidest
from maasi_planner.settings import PLANNERS, PlannerSettings

__all__ = [
    'ActiveSearch',
    'Intermittent',
    'Lawnmower',
    'MutualInformation',
    'NearestWidest',
    'Planner',
    'make_planner',
]


def make_planner(name: str, settings: PlannerSettings | None = None) -> Planner:
    """Return the planner called `name`.

    Parameters
    ----------
    name : str
        As in `PlannerSettings.name`.
    settings : PlannerSettings, optional
        Its parameters; `name` overrides the name in them.

    Raises
    ------
    ValueError
        If there is no planner of that name, or its own settings are wrong.
    """
    own = settings or PlannerSettings()
    if own.name != name:
        own = own.renamed(name)
    planner: Planner = PLANNERS.load(name)(own)
    return planner

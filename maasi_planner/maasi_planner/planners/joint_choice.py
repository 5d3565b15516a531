"""Joint choices of a team for objectives that are plain functions."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence

from maasi_filter.arrays import FloatArray
from maasi_planner.planners.separation import all_apart
from maasi_planner.settings import JointSettings
from maasi_planner.team import TeamView


def search_jointly(
    team: TeamView,
    settings: JointSettings,
    indices: Mapping[str, Sequence[int]],
    points: Mapping[str, FloatArray],
    value: Callable[[dict[str, int]], float],
    margin: float = 0.0,
) -> tuple[dict[str, int], float, bool, int]:
    """Return the best joint choice, its value, whether it is exact, and choices evaluated.

    Above the limit robots choose in turn and improve in rounds; -1: no candidate is admissible.
    """
    best: dict[str, int] = dict.fromkeys(indices, -1)
    best_value, evaluated = -math.inf, 0

    def fits(joint: dict[str, int]) -> bool:
        waypoints = {name: points[name][row] for name, row in joint.items() if row >= 0}
        return all_apart(team, waypoints)

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

"""Checks of chargers and batteries of robots with `endurance`."""

import math
from collections.abc import Iterator

import shapely

from maasi_filter.wording import number
from maasi_sim.scenario.free_space import FreeSpace
from maasi_sim.scenario.schema import RobotSettings

# Share of the clearance by which a charger may be closer to a wall, for rounding.
_SLACK = 1e-3


def charger_problems(space: FreeSpace) -> Iterator[str]:
    """Yield problems of a robot's chargers, `key: text`, as keys of the robot."""
    robot, home = space.robot, space.robot.endurance
    if home is None:
        return
    if home.full <= home.reserve:
        yield (
            f'endurance.full: read {home.full:g}, allowed is more than endurance.reserve, '
            f'{home.reserve:g}: it would never leave the charger'
        )
    chargers = {f'endurance.chargers[{i}]': position for i, position in enumerate(home.chargers)}
    # Its start is its charger; a robot may be off by its tolerance there.
    slack = _SLACK * robot.motion.clearance
    if not chargers:
        chargers, slack = {'start': robot.start}, 2.0 * robot.motion.tolerance
    for key, position in chargers.items():
        problem = _charger_problem(space, position, slack)
        if problem:
            which = '' if home.chargers else ', which is its charger'
            yield f'{key}: read {position}{which}, {problem}'


def _charger_problem(space: FreeSpace, position: list[float], slack: float) -> str:
    """Return the problem of a charger and the allowed positions, or an empty text."""
    robot, area = space.robot, space.area
    if not area.inside([position])[0]:
        outside = area.outside_by(position)
        where = (
            f'{number(outside)} m outside of the area' if outside > 0.0 else 'in a keep-out zone'
        )
        return f'{where}; allowed are positions inside of the area and outside of keep-out zones'
    gap = area.distances(position).min(initial=math.inf)
    if gap < robot.radius:
        return (
            f'{number(gap)} m from one of environment.obstacles; allowed is at least the radius, '
            f'{robot.radius:g} m'
        )
    point = shapely.Point(position[:2])
    if not space.parts or shapely.distance(space.parts, point).min() > slack:
        return (
            f'{number(space.gap(position))} m from the border, a keep-out zone or an obstacle; '
            'allowed is at least radius and motion.clearance, '
            f'{robot.radius + robot.motion.clearance:g} m'
        )
    if not space.gets_to(position):
        return (
            f'which the robot cannot reach from its start, {robot.start}; allowed are positions '
            f'reachable with its radius and motion.clearance, {robot.radius:g} and '
            f'{robot.motion.clearance:g} m'
        )
    return ''


def endurance_warnings(robot: RobotSettings) -> Iterator[str]:
    """Yield improbable battery settings, `key: text`, as keys of the robot."""
    if robot.endurance is None:
        return
    if not robot.battery.chargeable and not robot.external:
        yield (
            'battery.charging_power: read 0, but the robot has endurance: it returns home once '
            'and stays there'
        )
    if robot.endurance.per_second == 0.0 and robot.endurance.per_metre == 0.0:
        yield (
            'endurance: per_second and per_metre are 0, so the path home costs nothing: it '
            'returns home at its reserve from any distance'
        )

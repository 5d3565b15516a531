"""Reference for experiments: a planner that knows the positions of the targets."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.models.detection import detection_probability_at
from maasi_planner.planners.base import Planner, explain
from maasi_planner.planners.options import options_of, waiting_places
from maasi_planner.team import Decision, single_choice, stay

# A robot moves to its next target when the present one is found with this probability.
SURE = 0.8
# Weight of the mean time to find a target, relative to the time to find all.
MEAN_WEIGHT = 1.0
# Longest simulated search [measurement periods], and rounds of local search.
TICKS, ROUNDS = 4000, 80


class _Robots(NamedTuple):
    """The R robots in units of ticks, the shortest measurement period."""

    remaining_path: np.ndarray  # (R, n, 3) path until each is free [m], padded by its last position
    free: np.ndarray  # (R,) when each is free
    speed: np.ndarray  # (R,) [m]
    pause: np.ndarray  # (R,) additional time of a turn
    period: np.ndarray  # (R,)
    kind: np.ndarray  # (R,) of its detection, and its parameters
    parameters: np.ndarray  # (R, PARAMETERS)
    yaw: np.ndarray  # (R,) constant heading [rad], nan: along its motion


@njit(cache=True)
def _expected_end(robots, routes, targets, detected, dimension):
    """Return the ticks to find all on `routes` (R, n) of targets or -1, and (R, 3) first stops."""
    number, size = routes.shape
    # Probabilities of no detection and of exactly one.
    none, one = np.where(detected, 0.0, 1.0), np.where(detected, 1.0, 0.0)
    place = robots.remaining_path[:, 0].copy()
    travels = np.isnan(robots.yaw)
    cosine = np.where(travels, 1.0, np.cos(robots.yaw))
    sine = np.where(travels, 0.0, np.sin(robots.yaw))
    wait, current = np.zeros(number), np.zeros(number, np.int64)
    stops = robots.remaining_path[:, -1].copy()
    cost = 0.0
    for tick in range(TICKS):
        for r in range(number):
            goal = place[r].copy()
            share = 1.0
            if tick < robots.free[r]:
                goal = robots.remaining_path[r, tick].copy()
            else:
                while current[r] < size and routes[r, current[r]] >= 0:
                    j = routes[r, current[r]]
                    if none[j] + one[j] > 1.0 - SURE:
                        goal[:dimension] = targets[j, :dimension]
                        break
                    if current[r] == 0:
                        stops[r] = place[r]
                    current[r] += 1
                    wait[r] = robots.pause[r]
            offset = goal - place[r]
            distance = np.sqrt((offset * offset).sum())
            if distance > 0.0 and wait[r] >= 1.0:
                wait[r] -= 1.0
            elif distance > 0.0:
                level = np.hypot(offset[0], offset[1])
                if travels[r] and level > 0.0:
                    cosine[r] = offset[0] / level
                    sine[r] = offset[1] / level
                if tick >= robots.free[r]:
                    share = min(1.0, robots.speed[r] / distance)
                place[r] += share * offset
            if tick % robots.period[r] == 0:
                kind, parameters = robots.kind[r], robots.parameters[r]
                for j in range(len(targets)):
                    away = targets[j] - place[r]
                    x, y, z = away[0], away[1], away[2] if dimension == 3 else 0.0
                    chance = detection_probability_at(kind, parameters, x, y, z, cosine[r], sine[r])
                    one[j] += none[j] * chance - one[j] * chance
                    none[j] *= 1.0 - chance
        missing = none + one
        complete = np.prod(1.0 - missing)
        cost += 1.0 - complete + MEAN_WEIGHT * missing.mean()
        if complete > 0.99:
            break
    for r in range(number):
        if current[r] == 0 and routes[r, 0] >= 0:
            stops[r] = place[r]
    return cost, stops


class Clairvoyant(Planner):
    """Sends the robots along the best routes over the targets of `missing`, (n, 3) [m]."""

    def __init__(self, settings, missing):
        super().__init__(settings)
        self._missing = missing

    def finished(self, team):
        return None if len(self._missing()) else 'all targets are found'

    def decide(self, team):
        targets = self._missing()
        routes, stops = _best_routes(team, targets)
        places = waiting_places(team)
        decision = Decision(step=team.step)
        for name, route, stop in zip(team.names(), routes, stops):
            view = team.robots[name]
            if view.planning:
                wanted = np.vstack([stop, targets[route], targets])
                decision.robots[name] = robot = self._sent(team, name, wanted, places)
                places.append((robot.waypoint, view.radius))
        return explain(decision)

    @staticmethod
    def _sent(team, name, wanted, places):
        """Return the decision for the first of the wanted waypoints that can be reached."""
        view = team.robots[name]
        here = view.state.pose.position
        if team.dimension == 2:
            wanted[:, 2] = here[2]
        # Skip a waypoint nearer than a measurement period.
        least = view.motion.settings.speed * view.period_steps * team.step_time
        if np.linalg.norm(wanted[0] - here) < least:
            wanted = wanted[1:]
        for point in [*wanted, *view.candidates]:
            robots = {name: replace(view, candidates=point[None, :])}
            options = options_of(replace(team, robots=robots, taken=places), name, places)
            if not isinstance(options, str):
                return single_choice(options.points, options.prediction, 0, 'on the best route')
        return stay(view, 'stays: no target can be reached')


def _best_routes(team, targets):
    """Return a route over the targets for each robot, and the end of its first leg, (R, 3)."""
    robots, d = _robots(team, targets), team.dimension
    detected = np.zeros(len(targets), np.bool_)
    for cluster in team.clusters:
        # A target was detected where a cluster is near it.
        gaps = ((cluster.position[:d] - targets[:, :d]) ** 2).sum(axis=1)
        detected |= gaps <= 9.0 * np.trace(cluster.covariance[:d, :d])

    def simulated(routes):
        array = np.full((len(routes), len(targets) + 1), -1, np.int64)
        for row, route in zip(array, routes):
            row[: len(route)] = route
        return *_expected_end(robots, array, targets, detected, d), routes

    # Whichever target a robot reaches first is the next of its route.
    routes = [[] for _ in robots.free]
    ends, times = robots.remaining_path[:, -1].copy(), robots.free.astype(float)
    left = list(range(len(targets)))
    while left:
        gaps = np.linalg.norm(targets[left][None] - ends[:, None], axis=2) / robots.speed[:, None]
        r, column = np.unravel_index(int((times[:, None] + gaps).argmin()), gaps.shape)
        times[r] += gaps[r, column]
        ends[r] = targets[left[column]]
        routes[r].append(left.pop(int(column)))
    best, stops, routes = simulated(routes)
    for _ in range(ROUNDS):
        every = map(simulated, _neighbours(routes))
        found = next((item for item in every if item[0] < best - 1e-9), None)
        if found is None:
            break
        best, stops, routes = found
    return routes, stops


def _neighbours(routes):
    """Yield routes with one target moved, or a part of one reversed."""
    for r, route in enumerate(routes):
        for i, target in enumerate(route):
            rest = [[item for item in other if item != target] for other in routes]
            for s, other in enumerate(rest):
                for j in range(len(other) + 1):
                    if (s, j) != (r, i):
                        yield [*rest[:s], [*other[:j], target, *other[j:]], *rest[s + 1 :]]
            for j in range(i + 2, len(route) + 1):
                turned = [*route[:i], *route[i:j][::-1], *route[j:]]
                yield [*routes[:r], turned, *routes[r + 1 :]]


def _robots(team, targets):
    """Return all robots of a team for the simulation."""
    views = [team.robots[name] for name in team.names()]
    tick = min(view.period_steps for view in views)
    paths, rows = [], []
    for view in views:
        here = view.state.pose.position
        path = view.remaining_path
        path = here[None] if path is None or not len(path) else path
        paths.append(np.vstack([path[::tick], path[-1]]))
        settings = view.motion.settings
        speed = settings.speed * team.step_time
        goals = targets.copy()
        if team.dimension == 2:
            goals[:, 2] = here[2]
        lengths = view.motion.predict(view.state, goals, team.step_time).lengths
        over = lengths - np.linalg.norm(goals - here, axis=1) / speed
        pause = max(0.0, float(np.median(over))) / tick
        travels = settings.model == 'unicycle' or settings.heading == 'travel'
        yaw = np.nan if travels else view.state.pose.yaw
        period = max(1, round(view.period_steps / tick))
        rows.append((speed * tick, pause, period, *view.sensor.detection.kernel(), yaw))
    longest = max(map(len, paths))
    padded = [np.pad(path, ((0, longest - len(path)), (0, 0)), mode='edge') for path in paths]
    free = np.array([len(path) - 1 if len(path) > 2 else 0 for path in paths], np.int64)
    return _Robots(np.stack(padded), free, *map(np.array, zip(*rows)))


# `search` takes a class for one that needs settings alone.
clairvoyant = partial(Clairvoyant)

"""Tour: the team visits positions of a lattice in an order that finds targets early."""

from __future__ import annotations

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.wording import point as shown_point
from maasi_planner.planners.base import Planner, explain
from maasi_planner.planners.detour import PASSES, others_move, past_standing
from maasi_planner.planners.flights import flights_of
from maasi_planner.planners.lattice import Lattice, lanes_of
from maasi_planner.planners.options import affordable, waiting_places
from maasi_planner.planners.orienteering import plan_routes
from maasi_planner.planners.separation import crossed, free_of_robots
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import (
    CROSSED,
    NOTHING_LEFT,
    SAVES_BATTERY,
    Decision,
    RobotDecision,
    RobotView,
    TeamView,
    single_choice,
    stay,
)

# Tours are planned again if the sum of their prizes changes by this share.
CHANGE = 0.2
# A cell with less than this share of its prize is skipped.
STALE = 0.2
# A cluster this close to a planned one is the same [width of a cell].
SAME = 0.1
# Planned cells for each robot, even if they overlap.
ENOUGH = 3
# Longest leg: one cell, or so many times the arrival radius.
LEG = 5.0
# Published positions of a tour.
MOST_DRAWN = 200


class Tour(Planner):
    """A tour for each robot over cells of a lattice and clusters; the candidates are not used.

    The prize of a cell is the expected number of targets detected in passing it, that of a cluster
    its mass. All tours are planned again if prizes on them have changed, a cluster has appeared, or
    a robot has none left.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        super().__init__(settings)
        self._lattice: Lattice | None = None
        self._area: Area | None = None
        # Cells of the lattice, positions of cells and clusters, and planned prizes of both.
        self._chosen = np.zeros(0, np.int64)
        self.points = np.zeros((0, 0))
        self._planned = np.zeros(0)
        self.routes: dict[str, list[int]] = {}
        # Routes of later flights, after charging.
        self._later: dict[str, list[list[int]]] = {}
        # Last target of each robot, and robots that could not afford one at this step.
        self._target: dict[str, FloatArray] = {}
        self._refused: set[str] = set()

    def decide(self, team: TeamView) -> Decision:
        """See `Planner.decide`."""
        decision, standing = Decision(step=team.step), waiting_places(team)
        self._refused.clear()
        prizes = self._prizes(team)
        again = prizes is None
        if prizes is None:
            prizes = self.plan(team)
        for name in team.planning():
            chosen = self._next(team, name, prizes, standing, decision)
            if chosen is None and not again:
                prizes, again = self.plan(team), True
                chosen = self._next(team, name, prizes, standing, decision)
            if chosen is None:
                self._target.pop(name, None)
                why = SAVES_BATTERY if name in self._refused else NOTHING_LEFT
                chosen = stay(team.robots[name], f'stays: {why}')
            decision.robots[name] = chosen
            standing.append((chosen.waypoint, team.robots[name].radius))
        return explain(decision)

    def finished(self, team: TeamView) -> str | None:
        """See `Planner.finished`; also if few unseen targets are expected where robots can go."""
        reason = super().finished(team)
        if reason is not None:
            return reason
        lattice = self._lattice_of(team)
        left = float((lattice.trust * lattice.unseen(team.exploration).ravel()).sum())
        if left > self.settings.gain_threshold:
            return None
        return self._settled(
            team,
            f'no position is worth a visit: {100.0 * left:.2g} % of the expected targets are '
            f'unseen and reachable ({team.exploration.describe()})',
        )

    def _lattice_of(self, team: TeamView) -> Lattice:
        if self._lattice is None or self._area is not team.area:
            # A change of the area makes all plans obsolete.
            height = min(view.height for view in team.robots.values())
            self._lattice = Lattice(team.exploration, *lanes_of(team)[1:], height)
            self._area = team.area
            self.routes = {}
        return self._lattice

    def _prizes(self, team: TeamView) -> FloatArray | None:
        """Return the present prizes of the plan; None if it has to be made again."""
        lattice, number = self._lattice_of(team), len(self._chosen)
        left = np.array([index for route in self.routes.values() for index in route], np.int64)
        if set(self.searching(team)) != set(self.routes):
            return None
        prizes = np.zeros(len(self.points))
        # In the order of choice, as each gains what earlier ones leave.
        rows = np.sort(left[left < number])
        gains = lattice.gains(team.exploration, self._chosen[rows])
        prizes[rows] = team.area.expected_targets * gains
        for cluster in self.heavy(team):
            gaps = np.linalg.norm(self.points[number:] - cluster.position, axis=1)
            same = gaps < SAME * lattice.pitch
            if not same.any():
                return None
            prizes[number:][same] = cluster.mass
        moved = np.abs(prizes - self._planned)[left].sum()
        return None if moved > CHANGE * self._planned[left].sum() else prizes

    def plan(self, team: TeamView) -> FloatArray:
        """Plan the tours of all robots from their present or final positions; return the prizes."""
        lattice, names, heavy = self._lattice_of(team), self.searching(team), self.heavy(team)
        number = len(self._chosen)
        before = {
            name: [
                self._chosen[[i for i in flight if i < number]].tolist()
                for flight in (route, *self._later.get(name, []))
                if flight
            ]
            for name, route in self.routes.items()
        }
        self._chosen, gains = lattice.choose(team.exploration, ENOUGH * len(names))
        centres = np.array([item.position for item in heavy]).reshape(-1, team.dimension)
        self.points = np.vstack([lattice.points(team.exploration, self._chosen), centres])
        masses = [item.mass for item in heavy]
        self._planned = np.concatenate([team.area.expected_targets * gains, masses])
        prizes = self._planned.copy()
        for name in names:
            if name in self._target:
                # The robot is on its path there.
                gaps = np.linalg.norm(self.points - self._target[name], axis=1)
                prizes[gaps < SAME * lattice.pitch] = 0.0
        flights = flights_of(team, names, self.points, lattice.pitch)
        rows = {cell: row for row, cell in enumerate(self._chosen.tolist())}
        known = [
            np.array([rows[i] for i in cells if i in rows], np.int64)
            for cells in _flown_again(before, flights.names)
        ]
        # Lanes are those of the lattice; budgets are true lengths.
        frame = lattice.turn if flights.limited else lattice.frame(len(names))
        routes = plan_routes(
            self.points @ frame,
            prizes,
            flights.starts @ frame,
            flights.budgets,
            flights.ends @ frame if flights.limited else None,
            flights.speeds,
            known,
            worths=flights.worths,
        )
        self.routes = {name: route.tolist() for name, route in zip(names, routes)}
        self._later = {name: [] for name in names}
        for name, route in zip(flights.names[len(names) :], routes[len(names) :]):
            self._later[name].append(route.tolist())
        return self._planned

    def _next(
        self,
        team: TeamView,
        name: str,
        prizes: FloatArray,
        standing: list[tuple[FloatArray, float]],
        decision: Decision,
    ) -> RobotDecision | None:
        """Return the next leg of a robot's tour, without cells that lost their prize, or None."""
        view, route, d = team.robots[name], self.routes.get(name, []), team.dimension
        here = view.state.pose.position
        while route:
            index = route.pop(0)
            if prizes[index] < STALE * self._planned[index]:
                continue
            passed = [index]
            while route and self._straight(here[:d], passed[-1], route[0]):
                passed.append(route.pop(0))
            index = passed[-1]
            position = np.array(here)
            if d == 2:
                position[2] = view.height
            position[:d] = self.points[index]
            waypoint, whole = self._leg(team, view, position)
            moved = view.motion.keep_out.moved_out(here, waypoint)
            point = np.array([here if moved is None else moved])
            prediction = view.motion.predict(view.state, point, team.step_time)
            usable = prediction.reached[0] and prediction.lengths[0] > 0
            usable = usable and free_of_robots(point, view.radius, standing)[0]
            if usable and not affordable(team, name, prediction, prediction.reached)[0]:
                self._refused.add(name)
                continue
            if usable and crossed(team, name, prediction, decision):
                if others_move(team, name, decision):
                    route.insert(0, index)
                    return stay(view, CROSSED)
                if detour := past_standing(team, name, point[0], decision):
                    route.insert(0, index)
                    self._target[name] = detour[0][0, :d]
                    return single_choice(*detour, 0, PASSES)
                usable = False
            if not usable or not np.array_equal(point[0], waypoint):
                cells = [self._chosen[i] for i in passed if i < len(self._chosen)]
                self._lattice_of(team).trust[cells] *= 0.5
            elif not whole:
                route.insert(0, index)
            if usable:
                self._target[name] = (position if whole else waypoint)[:d]
                reason = self._reason(name, here[:d], index, prizes)
                chosen = single_choice(point, prediction, 0, reason)
                chosen.tour = self._rest(view, point[0], route)
                return chosen
        return None

    def _reason(self, name: str, here: FloatArray, index: int, prizes: FloatArray) -> str:
        def named(stop: int) -> str:
            return f'{shown_point(self.points[stop])} m'

        def gain(stop: int) -> str:
            potential = 'a potential target of mass ' if stop >= len(self._chosen) else ''
            return f'{potential}{prizes[stop]:.2g}' + ('' if potential else ' targets')

        rest = [stop for stop in self.routes[name] if stop != index]
        reason = f'next on its tour is {named(index)}, where it expects {gain(index)}'
        if rest:
            reason += f'; then {named(rest[0])}' + (f' and {len(rest) - 1} more' * (len(rest) > 1))
        owners = {stop: owner for owner, route in self.routes.items() for stop in route}
        others = np.array([stop for stop in owners if stop != index], np.int64)
        if len(others):
            gaps = np.linalg.norm(self.points[others] - here, axis=1)
            best = int(np.argmax(prizes[others] / np.maximum(gaps, 1e-9)))
            other, gap = int(others[best]), gaps[best]
            when = 'later' if owners[other] == name else f'assigned to {owners[other]}'
            reason += (
                f'; the alternative {named(other)}, {gain(other)}, {gap:.3g} m away, is {when}'
            )
        return reason

    def _rest(self, view: RobotView, start: FloatArray, route: list[int]) -> FloatArray:
        """Return the path after a waypoint, around obstacles, (n, 3)."""
        corners: list[tuple[float, float, float]] = []
        here, keep_out = start, view.motion.keep_out
        for index in route[:MOST_DRAWN]:
            position = np.array(start)
            position[: self.points.shape[1]] = self.points[index]
            moved = keep_out.moved_out(here, position)
            if moved is not None:
                corners += keep_out.route(here, moved)
                here = moved
        return np.array(corners).reshape(-1, 3)

    def _straight(self, here: FloatArray, index: int, following: int) -> bool:
        there, end = self.points[index], self.points[following]
        bent = np.linalg.norm(there - here) + np.linalg.norm(end - there)
        return bool(bent <= 1.001 * np.linalg.norm(end - here))

    def _leg(
        self, team: TeamView, view: RobotView, position: FloatArray
    ) -> tuple[FloatArray, bool]:
        """Return the waypoint of a leg, slightly beyond its end, and whether it is complete."""
        here, turning = view.state.pose.position, view.arrival_radius
        gap = max(float(np.linalg.norm(position - here)), 1e-9)
        longest = max(self._lattice_of(team).pitch, LEG * turning)
        whole = turning == 0.0 or gap <= 1.5 * longest
        end = position + (position - here) * 0.25 * turning / gap
        if not whole:
            end = here + (position - here) * longest / gap
        low, high = team.bounds.T
        end[: team.dimension] = np.clip(end[: team.dimension], low, high)
        return end, whole


def _flown_again(before: dict[str, list[list[int]]], names: list[str]) -> list[list[int]]:
    """Return the known cells of each flight, in the order of names; robots have several."""
    left = {name: iter(flights) for name, flights in before.items()}
    return [next(left.get(name, iter(())), []) for name in names]

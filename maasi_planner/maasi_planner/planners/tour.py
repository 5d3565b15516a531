"""Tour: the team visits places of a lattice in an order that finds targets early."""

from __future__ import annotations

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_planner.planners.base import Planner, explain, free_of_robots, waiting_places
from maasi_planner.planners.lattice import Lattice, passing
from maasi_planner.planners.orienteering import plan_ways
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import Decision, RobotDecision, RobotView, TeamView, single_choice, stay

# Tours are planned again when the prizes on them have changed by this share.
CHANGE = 0.2
# A place that has lost more than this share of its prize is left out.
STALE = 0.8
# Most places on a straight line that are one leg.
STRAIGHT = 100
OVER = 0.5
NEAR = 0.1
ENOUGH = 3
SPLIT = 1.0
LEG = 5.0


class Tour(Planner):
    """A tour for each robot over places of a lattice, and over clusters.

    The prize of a place is the number of unseen targets that is expected to be detected on passing
    it, that of a cluster its mass. Tours are planned again for all robots when the prizes on them
    have changed, when a cluster has appeared, or when a robot has none left. Candidates are not
    used.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        super().__init__(settings)
        self._lattice: Lattice | None = None
        self._detected = 0.0
        # Places of the plan: first those of the lattice, by index, then clusters; and their prizes.
        self._chosen = np.zeros(0, np.int64)
        self._points = np.zeros((0, 0))
        self._planned = np.zeros(0)
        self._ways: dict[str, list[int]] = {}
        # Where each robot was sent last.
        self._target: dict[str, FloatArray] = {}

    def decide(self, team: TeamView) -> Decision:
        """See `Planner.decide`."""
        decision = Decision(step=team.step)
        if self._lattice is None:
            reach = float(np.linalg.norm(team.bounds[:, 1] - team.bounds[:, 0]))
            seen = [passing(view, team.step_time, reach) for view in team.robots.values()]
            self._lattice = min(
                (Lattice(team.exploration, *one) for one in seen), key=lambda found: found.pitch
            )
        prizes, new = self._prizes(team)
        planned = new or self._changed(team, prizes)
        if planned:
            prizes = self._plan(team)
        places = waiting_places(team)
        for name in team.planning():
            chosen = self._next(team, name, prizes, places)
            if chosen is None and not planned:
                prizes, planned = self._plan(team), True
                chosen = self._next(team, name, prizes, places)
            if chosen is None:
                self._target.pop(name, None)
                chosen = stay(team.robots[name], 'stays: nothing is left for it')
            decision.robots[name] = chosen
            places.append((chosen.waypoint, team.robots[name].radius))
        return explain(decision)

    def finished(self, team: TeamView) -> str | None:
        """See `Planner.finished`; also when no place is worth a visit."""
        reason = super().finished(team)
        if reason is not None or self._lattice is None:
            return reason
        gains = self._lattice.choose(team.exploration)[1]
        if self.settings.expected_targets * gains.max(initial=0.0) > self.settings.gain_threshold:
            return None
        explored = 100.0 * team.exploration.explored_fraction()
        return self._settled(
            team, f'no place is worth a visit ({explored:.1f} % of the environment is explored)'
        )

    def _prizes(self, team: TeamView) -> tuple[FloatArray, bool]:
        """Return what the places of the plan are worth now, and whether a cluster is new."""
        assert self._lattice is not None
        number = len(self._chosen)
        prizes = np.zeros(len(self._points))
        # In the order of choice: places that have been visited are not counted.
        left = np.zeros(len(self._points), np.bool_)
        left[[index for way in self._ways.values() for index in way]] = True
        rows = np.flatnonzero(left[:number])
        gains = self._lattice.gains(team.exploration, self._chosen[rows])
        prizes[rows] = self.settings.expected_targets * gains
        new = False
        for cluster in self.heavy(team):
            if not len(self._points):
                return prizes, True
            gaps = np.linalg.norm(self._points[number:] - cluster.position, axis=1)
            near = gaps < NEAR * self._lattice.pitch
            prizes[number:][near] = cluster.mass
            new = new or not near.any()
        return prizes, new

    def _changed(self, team: TeamView, prizes: FloatArray) -> bool:
        """Return whether the tours are no longer good ones."""
        if set(team.names()) != set(self._ways):
            return True
        left = [index for way in self._ways.values() for index in way]
        moved = np.abs(prizes[left] - self._planned[left]).sum()
        return bool(moved > CHANGE * self._planned[left].sum())

    def _plan(self, team: TeamView) -> FloatArray:
        """Plan the tours of all robots from where they are, or will be; return the prizes."""
        assert self._lattice is not None
        self._chosen, gains = self._lattice.choose(team.exploration, ENOUGH * len(team.robots))
        heavy = self.heavy(team)
        centres = np.array([item.position for item in heavy]).reshape(-1, team.dimension)
        self._points = np.vstack([self._lattice.points[self._chosen], centres])
        masses = [item.mass for item in heavy]
        prizes = np.concatenate([self.settings.expected_targets * gains, masses])
        worth = prizes.copy()
        # They are on their way there.
        for target in self._target.values():
            gaps = np.linalg.norm(self._points - target[: team.dimension], axis=1)
            worth[gaps < 0.1 * self._lattice.pitch] = 0.0
        names = team.names()
        starts, speeds = [], []
        for name in names:
            view = team.robots[name]
            path = None if view.planning else view.remaining_path
            end = path[-1] if path is not None and len(path) else view.state.pose.position
            starts.append(end[: team.dimension])
            speeds.append(view.motion.settings.speed)
        endless = np.full(len(names), np.inf)
        ways = plan_ways(self._points, worth, np.array(starts), endless, speeds=np.array(speeds))
        self._ways = {name: way.tolist() for name, way in zip(names, ways)}
        self._planned = prizes
        return prizes

    def _next(
        self,
        team: TeamView,
        name: str,
        prizes: FloatArray,
        places: list[tuple[FloatArray, float]],
    ) -> RobotDecision | None:
        """Return the next leg of a robot's tour, past what has lost its prize; None: none left."""
        view, way = team.robots[name], self._ways[name]
        here = view.state.pose.position
        while way:
            index = way.pop(0)
            if prizes[index] < (1.0 - STALE) * self._planned[index]:
                continue
            index = self._straight_on(here[: team.dimension], index, way)
            target = np.array(here)
            if team.dimension == 2 and len(view.candidates):
                target[2] = view.candidates[0, 2]
            target[: team.dimension] = self._points[index]
            gap = float(np.linalg.norm(target - here))
            longest = max(SPLIT * self._lattice.pitch, LEG * view.arrival_radius)
            if view.arrival_radius > 0.0 and gap > 1.5 * longest:
                target = here + (target - here) * longest / gap
                way.insert(0, index)
                ahead = target
            else:
                ahead = self._beyond(team, view, target)
            point = view.motion.keep_out.moved_out(here, ahead)
            if point is None or not free_of_robots(point[None, :], view.radius, places)[0]:
                if way and way[0] == index:
                    way.pop(0)
                continue
            prediction = view.motion.predict(view.state, point[None, :], team.step_time)
            if not prediction.reached[0] or prediction.lengths[0] == 0:
                if way and way[0] == index:
                    way.pop(0)
                continue
            self._target[name] = target
            reason = f'next place of its tour, prize {prizes[index]:.3g}, {len(way)} to follow'
            return single_choice(point[None, :], prediction, 0, reason)
        return None

    def _beyond(self, team: TeamView, view: RobotView, target: FloatArray) -> FloatArray:
        """Return a waypoint so far behind a place that the robot passes it before it turns."""
        way = target - view.state.pose.position
        ahead = target + OVER * view.arrival_radius * way / max(float(np.linalg.norm(way)), 1e-9)
        low, high = team.bounds.T
        ahead[: team.dimension] = np.clip(ahead[: team.dimension], low, high)
        return ahead

    def _straight_on(self, here: FloatArray, index: int, way: list[int]) -> int:
        """Return the last of the places that follow on a straight line, and pass the others."""
        passed = 1
        while way and passed < STRAIGHT:
            direct = np.linalg.norm(self._points[way[0]] - here)
            bent = np.linalg.norm(self._points[index] - here)
            bent += np.linalg.norm(self._points[way[0]] - self._points[index])
            if bent > 1.001 * direct:
                break
            index, passed = way.pop(0), passed + 1
        return index

"""P2 of 004 as a mixed-integer problem for SCIP: the oracle of tests, and a baseline of speed."""

import time

import numpy as np
import pyscipopt
from pyscipopt import quicksum

from maasi_planner.buildings.problem import TOUCH

BIG = 1000.0


def checked_objective(solver, problem, plan, tolerance=2e-4):
    """Return the objective of a lean plan, after checking all that it must satisfy."""
    d, s = solver.dynamics, solver.settings
    P, v, u = plan.positions, plan.velocities, plan.controls
    assert np.abs(P[1:] - P[:-1] - d.step * v[:-1]).max() <= tolerance
    change = d.step / d.mass * (u - d.weight)
    assert np.abs(v[1:] - d.retained * v[:-1] - change).max() <= tolerance
    for values, low, high in (
        (P[0], problem.position, problem.position),
        (P[2:], *problem.area.T),
        (v[0], problem.velocity, problem.velocity),
        (v[1:], -d.speed, d.speed),
        (u, -d.force, d.force),
    ):
        assert (low - tolerance <= values).all() and (values <= high + tolerance).all()
    for a in range(3 if s.brake_at_end else 0):
        for factor, up, down in stops(d, a):
            low, high = problem.area[a] + [-down - tolerance, up + tolerance]
            assert low <= P[-1, a] + factor * v[-1, a] <= high
    total = s.guidance_weight * ((P[s.guided] - problem.target) ** 2).sum()
    total += s.smoothness_weight * (np.diff(u, axis=0) ** 2).sum()
    cuboids = [cuboid for _, cuboid in plan.visits]
    assert len(set(cuboids)) == len(cuboids) and problem.wanted[cuboids].all()
    for step, cuboid in plan.visits:
        box = problem.cuboids[cuboid]
        assert (P[step] >= box[:, 0] - tolerance).all()
        assert (P[step] <= box[:, 1] + tolerance).all()
        total -= s.rewards()[step]
    for k in range(2, s.horizon + 1):
        ends = P[k - s.between_samples : k + 1]
        for box in problem.obstacles:
            below = (ends <= box[:, 0] + 2e-3).all(axis=0)
            assert (below | (ends >= box[:, 1] - 2e-3).all(axis=0)).any(), (k, ends, box)
    return total


def stops(d, a):
    """Return way = P + factor v - up (moving up), + down (moving down), after each step."""
    result = []
    for steps in range(1, d.braking_steps() + 1):
        # v -> way, by simulating v = 0 and v = 1 without stopping.
        ways = np.zeros((2, 2))
        for way, loss in zip(ways, d.deceleration[:, a]):
            speeds = np.array([0.0, 1.0])
            for _ in range(steps):
                way += d.step * speeds
                speeds = d.retained * speeds - loss
        result.append((ways[0, 1] - ways[0, 0], -ways[0, 0], -ways[1, 0]))
    return result


class MixedProblem:
    """Variables P (T + 1, 3), v and u (T, 3), and constraints of P2 in `model`."""

    def __init__(self, solver, problem, apart):
        self.dynamics, self.settings, self.problem = solver.dynamics, solver.settings, problem
        # Whether no two cuboids can be visited at one step.
        self.apart = apart
        self.model = pyscipopt.Model()
        self.model.hideOutput()
        self.add = self.model.addCons
        self._dynamics()
        rewards = self._visits()
        self._obstacles()
        if self.settings.brake_at_end:
            self._braking()
        self.model.setObjective(quicksum([*self._squares(), *rewards]), 'minimize')

    def _variable(self, lower, upper):
        return self.model.addVar(vtype='C', lb=lower, ub=upper)

    def _binary(self):
        return self.model.addVar(vtype='B')

    def _dynamics(self):
        d, T, p = self.dynamics, self.settings.horizon, self.problem
        self.P, self.v = np.empty((2, T + 1, 3), dtype=object)
        self.u = np.empty((T, 3), dtype=object)
        for a in range(3):
            for k in range(T + 1):
                # P_1 is given by the state, too.
                bounds = [(p.position[a],) * 2, (-1e6, 1e6), p.area[a]][min(k, 2)]
                self.P[k, a] = self._variable(*bounds)
                bounds = (p.velocity[a],) * 2 if k == 0 else (-d.speed, d.speed)
                self.v[k, a] = self._variable(*bounds)
            for k in range(T):
                u = self.u[k, a] = self._variable(-d.force, d.force)
                self.add(self.P[k + 1, a] == self.P[k, a] + d.step * self.v[k, a])
                change = d.step / d.mass * (u - d.weight[a])
                self.add(self.v[k + 1, a] == d.retained * self.v[k, a] + change)

    def _reach(self):
        d, T, p = self.dynamics, self.settings.horizon, self.problem
        reach = np.empty((T + 1, 3, 2))
        for side, sign in enumerate((-1.0, 1.0)):
            place, speed = p.position.astype(float), p.velocity.astype(float)
            for k in range(T + 1):
                reach[k, :, side] = place
                place, speed = d.next(place, speed, np.full(3, sign * d.force))
                speed = np.clip(speed, -d.speed, d.speed)
        reach[2:, :, 0] = np.maximum(reach[2:, :, 0], p.area[:, 0])
        reach[2:, :, 1] = np.minimum(reach[2:, :, 1], p.area[:, 1])
        return reach

    def _visits(self):
        """Return the terms of the objective that visits gain."""
        T, p = self.settings.horizon, self.problem
        self.reach = self._reach()
        rewards, terms, possible = self.settings.rewards(), [], {}
        for n in np.flatnonzero(p.wanted):
            visits = []
            for k in range(1, T + 1):
                low, high = self.reach[k].T
                # Where the next step leads is given: a visit on a face counts despite rounding.
                box = p.cuboids[n] + [-TOUCH, TOUCH] if k == 1 else p.cuboids[n]
                if (box[:, 0] <= high).all() and (box[:, 1] >= low).all():
                    visits.append(self._binary())
                    terms.append(-rewards[k] * visits[-1])
                    key = k, None if self.apart else n
                    possible.setdefault(key, []).append((visits[-1], box))
            if len(visits) > 1:
                self.add(quicksum(visits) <= 1)
        for (k, _), betas in possible.items():
            for a in range(3):
                low, high = self.reach[k, a]
                lifts = quicksum(max(box[a, 0] - low, 0.0) * beta for beta, box in betas)
                drops = quicksum(max(high - box[a, 1], 0.0) * beta for beta, box in betas)
                self.add(self.P[k, a] >= low + lifts)
                self.add(self.P[k, a] <= high - drops)
        return terms

    def _obstacles(self):
        T, p = self.settings.horizon, self.problem
        for box in p.obstacles:
            for k in range(2, T + 1):
                steps = [k - 1, k] if self.settings.between_samples else [k]
                low, high = self.reach[steps, :, 0].min(axis=0), self.reach[steps, :, 1].max(axis=0)
                if (high <= box[:, 0]).any() or (low >= box[:, 1]).any():
                    continue
                faces = []
                for a in range(3):
                    # The lower face, then the upper one, mirrored.
                    for side, sign in ((0, 1), (1, -1)):
                        face = sign * box[a, side]
                        nearest = (low, -high)[side][a]
                        if face <= sign * p.area[a, side] or nearest > face:
                            continue
                        faces.append(self._binary())
                        for i in steps:
                            most = max(sign * self.reach[i, a, 1 - side] - face, 0.0)
                            self.add(sign * self.P[i, a] <= face + most * faces[-1])
                self.add(quicksum(faces) <= len(faces) - 1)

    def _braking(self):
        """The way to brake, each axis with full force, stays in the area and beyond a face."""
        p, ways = self.problem, []
        for a in range(3):
            end, speed = self.P[-1, a], self.v[-1, a]
            found = [(end + f * speed, up, down) for f, up, down in stops(self.dynamics, a)]
            for way, up, down in found:
                self.add(way >= p.area[a, 0] - down)
                self.add(way <= p.area[a, 1] + up)
            ways.append([(1.0 * end, 0.0, 0.0), *found])
        for box in p.obstacles:
            # Of the six faces one is kept beyond.
            z = np.array([self._binary() for _ in range(6)]).reshape(3, 2)
            self.add(quicksum(z.ravel()) <= 5)
            for a in range(3):
                for way, up, down in ways[a]:
                    self.add(way <= box[a, 0] + up + BIG * z[a, 0])
                    self.add(way >= box[a, 1] - down - BIG * z[a, 1])

    def _squares(self):
        """Yield the squares of the objective, each as a variable: its relaxation is tighter."""
        T, p, s = self.settings.horizon, self.problem, self.settings
        for a in range(3):
            parts = [(s.guidance_weight, self.P[s.guided, a] - p.target[a])]
            parts += [(s.smoothness_weight, self.u[k, a] - self.u[k - 1, a]) for k in range(1, T)]
            for weight, part in parts:
                inner, square = self._variable(None, None), self._variable(0.0, None)
                self.add(inner == part)
                self.add(weight * inner * inner <= square)
                yield square


def solve_with_scip(solver, problem, apart=False, gap=1e-6, limit=60.0):
    """Return (lower bound, value of the best point found, seconds) of SCIP."""
    begun = time.perf_counter()
    model = MixedProblem(solver, problem, apart).model
    model.setParam('limits/time', limit)
    model.setParam('limits/absgap', gap)
    model.setParam('parallel/maxnthreads', 1)
    model.optimize()
    value = model.getObjVal() if model.getNSols() else np.inf
    return model.getDualbound(), value, time.perf_counter() - begun

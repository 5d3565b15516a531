"""P2 of 004 as a mixed-integer problem for SCIP: the oracle of tests, and a baseline of speed."""

import time

import numpy as np
import pyscipopt

from maasi_planner.buildings.problem import TOUCH

BIG = 1000.0


class MixedProblem:
    """Columns and rows of P2; `squares` are (weight, columns, coefficients, constant)."""

    def __init__(self, solver, problem, apart=False):
        self.dynamics, self.settings, self.problem = solver.dynamics, solver.settings, problem
        # Whether no two cuboids can be visited at one step.
        self.apart = apart
        self.lower, self.upper, self.integer, self.cost = [], [], [], []
        self.rows = []
        self.squares = []
        self._dynamics_rows()
        self._visit_rows()
        self._obstacle_rows()
        if self.settings.brake_at_end:
            self._braking_rows()
        self._objective()

    def column(self, lower, upper, integer=False, cost=0.0):
        self.lower.append(lower)
        self.upper.append(upper)
        self.integer.append(integer)
        self.cost.append(cost)
        return len(self.cost) - 1

    def binary(self, cost=0.0):
        return self.column(0, 1, True, cost)

    def row(self, columns, coefficients, lower, upper):
        self.rows.append((list(columns), list(coefficients), lower, upper))

    def _dynamics_rows(self):
        d, T, p = self.dynamics, self.settings.horizon, self.problem
        self.P = np.empty((T + 1, 3), dtype=int)
        self.v = np.empty((T + 1, 3), dtype=int)
        self.u = np.empty((T, 3), dtype=int)
        gamma = d.step / d.mass
        for a in range(3):
            for k in range(T + 1):
                # P_1 is given by the state, too.
                bounds = [(p.position[a],) * 2, (-1e6, 1e6), p.area[a]][min(k, 2)]
                self.P[k, a] = self.column(*bounds)
                bounds = (p.velocity[a],) * 2 if k == 0 else (-d.speed, d.speed)
                self.v[k, a] = self.column(*bounds)
            for k in range(T):
                u = self.u[k, a] = self.column(-d.force, d.force)
                self.row([self.P[k + 1, a], self.P[k, a], self.v[k, a]], [1, -1, -d.step], 0, 0)
                fall = -gamma * d.weight[a]
                self.row([self.v[k + 1, a], self.v[k, a], u], [1, -d.retained, -gamma], fall, fall)

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

    def _visit_rows(self):
        T, p = self.settings.horizon, self.problem
        self.reach = self._reach()
        rewards = self.settings.rewards()
        possible = {}
        for n in np.flatnonzero(p.wanted):
            visits = []
            for k in range(1, T + 1):
                low, high = self.reach[k].T
                # Where the next step leads is given: a visit on a face counts despite rounding.
                box = p.cuboids[n] + [-TOUCH, TOUCH] if k == 1 else p.cuboids[n]
                if (box[:, 0] <= high).all() and (box[:, 1] >= low).all():
                    beta = self.binary(-rewards[k])
                    visits.append(beta)
                    possible.setdefault((k, None if self.apart else n), []).append((beta, box))
            if len(visits) > 1:
                self.row(visits, [1] * len(visits), -np.inf, 1)
        for (k, _), betas in possible.items():
            columns = [beta for beta, _ in betas]
            for a in range(3):
                low, high = self.reach[k, a]
                lifts = [max(box[a, 0] - low, 0.0) for _, box in betas]
                drops = [max(high - box[a, 1], 0.0) for _, box in betas]
                self.row([self.P[k, a], *columns], [1, *(-x for x in lifts)], low, np.inf)
                self.row([self.P[k, a], *columns], [1, *drops], -np.inf, high)

    def _obstacle_rows(self):
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
                        z = self.binary()
                        faces.append(z)
                        for i in steps:
                            most = max(sign * self.reach[i, a, 1 - side] - face, 0.0)
                            self.row([self.P[i, a], z], [sign, -most], -np.inf, face)
                self.row(faces, [1] * len(faces), -np.inf, len(faces) - 1)

    def _braking_rows(self):
        """The way to brake, each axis with full force, stays in the area and beyond a face."""
        T, p = self.settings.horizon, self.problem
        ends = [[self.P[T, a], self.v[T, a]] for a in range(3)]
        for a in range(3):
            for factor, up, down in self._stops(a):
                self.row(ends[a], [1, factor], p.area[a, 0] - down, np.inf)
                self.row(ends[a], [1, factor], -np.inf, p.area[a, 1] + up)
        for box in p.obstacles:
            # Of the six faces one is kept beyond.
            z = np.array([self.binary() for _ in range(6)]).reshape(3, 2)
            self.row(z.ravel(), [1] * 6, -np.inf, 5)
            for a in range(3):
                for factor, up, down in ((0.0, 0.0, 0.0), *self._stops(a)):
                    below, above = ([*ends[a], column] for column in z[a])
                    self.row(below, [1, factor, -BIG], -np.inf, box[a, 0] + up)
                    self.row(above, [1, factor, BIG], box[a, 1] - down, np.inf)

    def _stops(self, a):
        """Return way = P + factor v - up (moving up), + down (moving down), after each step."""
        d = self.dynamics
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

    def _objective(self):
        T, p, s = self.settings.horizon, self.problem, self.settings
        for a in range(3):
            self.squares.append((s.guidance_weight, [self.P[s.guided, a]], [1.0], -p.target[a]))
            for k in range(1, T):
                pair = [self.u[k, a], self.u[k - 1, a]]
                self.squares.append((s.smoothness_weight, pair, [1.0, -1.0], 0.0))

    def value(self, x):
        total = float(np.dot(self.cost, x))
        for weight, columns, coefficients, constant in self.squares:
            total += weight * (np.dot(coefficients, x[columns]) + constant) ** 2
        return total

    def check(self, plan, tolerance=2e-4):
        """Return the objective of a lean plan, after checking all rows that do not choose."""
        x = np.zeros(len(self.cost))
        x[self.P], x[self.v], x[self.u] = plan.positions, plan.velocities, plan.controls
        for columns, coefficients, lower, upper in self.rows:
            if not any(self.integer[c] for c in columns):
                value = np.dot(coefficients, x[columns])
                assert lower - tolerance <= value <= upper + tolerance
        continuous = ~np.array(self.integer)
        assert (x[continuous] >= np.array(self.lower)[continuous] - tolerance).all()
        assert (x[continuous] <= np.array(self.upper)[continuous] + tolerance).all()
        total = self.value(x)
        cuboids = [cuboid for _, cuboid in plan.visits]
        assert len(set(cuboids)) == len(cuboids) and self.problem.wanted[cuboids].all()
        for step, cuboid in plan.visits:
            box = self.problem.cuboids[cuboid]
            assert (plan.positions[step] >= box[:, 0] - tolerance).all()
            assert (plan.positions[step] <= box[:, 1] + tolerance).all()
            total -= self.settings.rewards()[step]
        for k in range(2, self.settings.horizon + 1):
            ends = plan.positions[k - self.settings.between_samples : k + 1]
            for box in self.problem.obstacles:
                below = (ends <= box[:, 0] + 2e-3).all(axis=0)
                assert (below | (ends >= box[:, 1] - 2e-3).all(axis=0)).any(), (k, ends, box)
        return total


def solve_with_scip(mixed, gap=1e-6, limit=60.0):
    """Return (lower bound, value of the best point found, seconds) of SCIP."""
    begun = time.perf_counter()
    model = pyscipopt.Model()
    model.hideOutput()
    model.setParam('limits/time', limit)
    model.setParam('limits/absgap', gap)
    model.setParam('parallel/maxnthreads', 1)
    columns = [
        model.addVar(vtype='B' if kind else 'C', lb=low, ub=high)
        for low, high, kind in zip(mixed.lower, mixed.upper, mixed.integer)
    ]

    def total(indices, coefficients):
        return pyscipopt.quicksum(c * columns[i] for i, c in zip(indices, coefficients))

    for indices, coefficients, low, high in mixed.rows:
        value = total(indices, coefficients)
        if low > -np.inf:
            model.addCons(value >= low)
        if high < np.inf:
            model.addCons(value <= high)
    # A column for each square: as one row, its relaxation is far weaker.
    squares = []
    for weight, indices, coefficients, constant in mixed.squares:
        inner = model.addVar(vtype='C', lb=None, ub=None)
        model.addCons(inner == total(indices, coefficients) + constant)
        squares.append(model.addVar(vtype='C', lb=0.0, ub=None))
        model.addCons(weight * inner * inner <= squares[-1])
    linear = total(range(len(columns)), mixed.cost)
    model.setObjective(linear + pyscipopt.quicksum(squares), 'minimize')
    model.optimize()
    value = model.getObjVal() if model.getNSols() else np.inf
    return model.getDualbound(), value, time.perf_counter() - begun

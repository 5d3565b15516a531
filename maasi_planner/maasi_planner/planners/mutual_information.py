"""Mutual information with the event of an empty measurement set (Dames and Kumar, 2015).

Used as in 003, section 4, and as the baseline of 000, section 5.1. Targets are a Poisson random
finite set with the filter's intensity D, and Lambda = 0 is the event of no measurement. With
p(X) = prod (1 - pi(x)) the probability of that event given the targets,

    I = h(E p) - E h(p),   h(p) = -p log p - (1 - p) log(1 - p),

and for a Poisson set E p^n = exp(-int (1 - (1 - pi)^n) D) and
E p log p = E p * int (1 - pi) log(1 - pi) D, while E (1 - p) log(1 - p) is the series
-sum_n (E p^n - E p^(n + 1)) / n.
"""

import math

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_planner.objective.sight import probability_over
from maasi_planner.planners.base import Planner, explain
from maasi_planner.planners.joint_choice import search_jointly
from maasi_planner.planners.options import usable_options
from maasi_planner.settings import JointSettings
from maasi_planner.team import ASSIGNED, Decision, RobotView, TeamView, single_choice, stay

EXACT_TERMS = 48
DOUBLINGS = 40


@njit(cache=True)
def mutual_information(missed: FloatArray, weights: FloatArray) -> float:
    """Return the mutual information of targets and the empty measurement set, in nats.

    missed (n,): probability 1 - pi of missing a target at each particle, multiplied over several
    measurements; weights (n,): expected number of targets at each. The first terms of the series
    are summed exactly, further ones in blocks of doubling size, with an error far below 1e-3 of the
    result.
    """
    number = missed.shape[0]
    power = np.ones(number)
    log_term = 0.0
    seen = 0.0
    for i in range(number):
        seen += weights[i] * (1.0 - missed[i])
        if 0.0 < missed[i] < 1.0:
            log_term += weights[i] * missed[i] * math.log(missed[i])
    if seen <= 0.0:
        return 0.0
    empty = math.exp(-seen)
    total = 0.0
    if empty > 0.0:
        total += empty * seen
    rest = -math.expm1(-seen)
    total -= rest * math.log(rest)
    # total is h(E p); now subtract E h(p).
    total += empty * log_term
    last = empty
    for i in range(number):
        power[i] = missed[i]
    for n in range(1, EXACT_TERMS + 1):
        exponent = 0.0
        for i in range(number):
            power[i] *= missed[i]
            exponent += weights[i] * (1.0 - power[i])
        value = math.exp(-exponent)
        total -= (last - value) / n
        last = value
    # power is missed^(N + 1) here; continue in blocks of doubling size.
    begin = EXACT_TERMS + 1
    for _ in range(DOUBLINGS):
        exponent = 0.0
        for i in range(number):
            power[i] *= power[i]
            exponent += weights[i] * (1.0 - power[i])
        value = math.exp(-exponent)
        end = 2 * begin
        # Mean of 1/n over the block.
        total -= (last - value) * math.log((end - 0.5) / (begin - 0.5)) / (end - begin)
        if last - value < 1e-15:
            break
        last = value
        begin = end
    return max(total, 0.0)


def lower_factor(covariance: FloatArray) -> FloatArray:
    """Return the Cholesky factor of a covariance, which may be singular."""
    lower = np.zeros_like(covariance)
    for i in range(len(lower)):
        for j in range(i + 1):
            rest = float(covariance[i, j]) - sum(float(lower[i, k] * lower[j, k]) for k in range(j))
            if i == j:
                lower[i, i] = math.sqrt(max(rest, 0.0))
            elif lower[j, j] > 0.0:
                lower[i, j] = rest / lower[j, j]
    return lower


def intensity(team: TeamView) -> tuple[FloatArray, FloatArray]:
    """Return points (n, d) and weights (n,) for the intensity.

    Each cluster has 2 d + 1 points of equal weight with its mean and covariance.
    """
    d = team.dimension
    points, weights = [np.zeros((0, d))], [np.zeros(0)]
    for cluster in team.clusters:
        root = lower_factor(np.asarray(cluster.covariance, dtype=float)[:d, :d])
        scale = math.sqrt(d + 0.5)
        offsets = np.vstack([np.zeros((1, d)), scale * root.T, -scale * root.T])
        points.append(np.asarray(cluster.position, dtype=float)[:d] + offsets)
        weights.append(np.full(2 * d + 1, cluster.mass * (0.5 / (d + 0.5))))
    return np.vstack(points), np.concatenate(weights)


def heading_to(view: RobotView, start: FloatArray, end: FloatArray) -> float:
    """Return the heading of a robot after it went from `start` to `end`, radians."""
    settings = view.motion.settings
    turns = settings.model == 'unicycle' or settings.heading == 'travel'
    if turns and math.hypot(end[0] - start[0], end[1] - start[1]) > 1e-9:
        return math.atan2(end[1] - start[1], end[0] - start[0])
    return view.state.pose.yaw


class MutualInformation(Planner):
    """The joint waypoints with the largest mutual information, and no exploration.

    Each robot measures at its waypoint, and continues straight on if no waypoint is informative.
    """

    measures_underway = False

    keys = JointSettings
    settings: JointSettings

    def __init__(self, settings: JointSettings) -> None:
        super().__init__(settings)
        self._headings: dict[str, FloatArray] = {}

    def decide(self, team: TeamView) -> Decision:
        """See `Planner.decide`."""
        decision = Decision(step=team.step)
        options = usable_options(team, decision)
        particles, weights = intensity(team)
        missed = {
            name: self._missed(team, team.robots[name], option.points, particles)
            for name, option in options.items()
        }

        def value(joint: dict[str, int]) -> float:
            product = np.ones(len(weights))
            for name, row in joint.items():
                if row >= 0:
                    product = product * missed[name][row]
            return float(mutual_information(product, weights))

        indices = {}
        for name, option in options.items():
            # Uninformative candidates are ordered by how straight on they are.
            offsets = option.points - team.robots[name].state.pose.position
            lengths = np.sqrt((offsets * offsets).sum(axis=1))
            last = self._headings.get(name, np.zeros(3))
            order = (offsets * last).sum(axis=1) / np.maximum(lengths, 1e-12)
            rows = np.flatnonzero(option.allowed)
            indices[name] = rows[np.argsort(-order[rows], kind='stable')].tolist()
        points = {name: option.points for name, option in options.items()}
        chosen, best, decision.exact, decision.evaluated = search_jointly(
            team, self.settings, indices, points, value, 1e-12
        )
        decision.objective = max(best, 0.0)
        for name, option in options.items():
            view, row = team.robots[name], chosen[name]
            if row < 0:
                decision.robots[name] = stay(view, f'stays: {ASSIGNED}')
                continue
            values = np.array([value({**chosen, name: w}) for w in range(len(option.points))])
            offset = option.points[row] - view.state.pose.position
            length = math.sqrt(float((offset * offset).sum()))
            if length > 1e-9:
                self._headings[name] = offset / length
            reason = 'no waypoint promises information: continues straight on'
            if values[row] > 0.0:
                bits = values[row] / math.log(2.0)
                reason = f'expects {bits:.3g} bits of information about targets'
            result = single_choice(option.points, option.prediction, row, reason)
            result.target_refinement = values
            result.objective = np.where(option.allowed, values, -np.inf)
            result.measurements = np.ones(len(option.points), np.int64)
            decision.robots[name] = result
        return explain(decision)

    @staticmethod
    def _missed(
        team: TeamView, view: RobotView, positions: FloatArray, points: FloatArray
    ) -> FloatArray:
        here = np.array(view.state.pose.position)
        out = np.ones((len(positions), len(points)))
        if len(points):
            for row, point in zip(out, positions):
                pose = Pose.from_yaw(point, heading_to(view, here, point))
                row[:] = 1.0 - probability_over(team.area, view.sensor.detection, points, pose)
        return out

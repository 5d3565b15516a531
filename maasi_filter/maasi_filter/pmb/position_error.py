"""Errors of a robot's position beyond those it reports, learnt from how well its scans fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_filter.measurement_check import CheckedMeasurement
from maasi_filter.pmb.association import propagate
from maasi_filter.pmb.component import Component
from maasi_filter.pmb.factors import MOST_PROBABLE

# Deviations of the error that are compared, in deviations of the range.
LEVELS = np.array([0.0, 0.5, 1.0, 2.0, 4.0])
# Their probabilities beforehand.
PRIOR = np.array([0.96, 0.01, 0.01, 0.01, 0.01])
# Probability that the error is another one from one scan to the next.
CHANGE = 0.005
# Components below this r are not considered.
LEAST_EXISTENCE = 0.1
# Gate on the range, in deviations of the largest error and root mean square radii.
GATE = 4.0


@njit(cache=True, error_model='numpy')
def _log_sums(errors, jacobians, covariances, noise, variances, odds, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill the log of the sum of the weights of all associations for each variance [m^2].

    `errors` (n, m, d), `jacobians` and `covariances` (n, d, d) are of n targets, `noise` (m, d, d)
    is R, `odds` (n, m) are those of a detection of density 1.
    """
    n, m, d = errors.shape
    psi = np.empty((n, m))
    missed, caused, new = np.empty(n), np.empty((n, m)), np.empty(m)
    root = np.empty((d, d))
    solved = np.empty(d)
    for k in range(len(variances)):
        for i in range(n):
            spread = covariances[i].copy()
            for a in range(d):
                spread[a, a] += variances[k]
            expected = jacobians[i] @ spread @ jacobians[i].T
            for j in range(m):
                exponent = 0.0
                for a in range(d):
                    for b in range(a + 1):
                        value = expected[a, b] + noise[j, a, b]
                        for c in range(b):
                            value -= root[a, c] * root[b, c]
                        root[a, b] = math.sqrt(max(value, 1e-30)) if a == b else value / root[b, b]
                    value = errors[i, j, a]
                    for c in range(a):
                        value -= root[a, c] * solved[c]
                    solved[a] = value / root[a, a]
                    exponent -= 0.5 * solved[a] ** 2 + math.log(root[a, a])
                psi[i, j] = odds[i, j] * math.exp(exponent) / (2.0 * math.pi) ** (0.5 * d)
        out[k] = propagate(psi, missed, caused, new)


def _near(member: CheckedMeasurement, items: Sequence[Component], reach: float) -> list[Component]:
    """Return the components whose distance from the robot is that of a detection, nearly."""
    if not (items and len(member.values)):
        return []
    means = np.array([item.density.mean for item in items])
    radii = np.array([item.density.radius for item in items])
    offsets = means - member.pose.position[: means.shape[1]]
    gaps = np.abs(np.sqrt(np.square(offsets).sum(axis=1))[:, None] - member.values[:, 0])
    near = gaps.min(axis=1) < reach + GATE * radii
    return [item for item, kept in zip(items, near.tolist()) if kept]


@dataclass
class PositionErrors:
    """Probabilities of the errors in LEVELS, for each robot."""

    probabilities: dict[str, FloatArray] = field(default_factory=dict)  # By robot: (k,)

    def learn(
        self,
        member: CheckedMeasurement,
        components: Sequence[Component],
        clutter: float,
        unseen: float,
    ) -> float:
        """Return the most probable deviation [m] after a scan, on each axis.

        `clutter` is kappa, per unit of measurement space; `unseen` N0 / V, per m^d: the largest
        intensity of undetected targets.
        """
        before = self.probabilities.get(member.robot, PRIOR)
        unit = math.sqrt(member.sensor.covariance[0, 0])
        likely = [item for item in components if item.existence >= LEAST_EXISTENCE]
        likely = _near(member, likely, GATE * unit * LEVELS[-1])
        if likely:
            logs = self._log_likelihoods(member, likely, clutter, unseen, unit)
            after = ((1.0 - CHANGE) * before + CHANGE * PRIOR) * np.exp(logs - logs.max())
            before = self.probabilities[member.robot] = after / after.sum()
        return unit * float(LEVELS[before.argmax()])

    def _log_likelihoods(
        self,
        member: CheckedMeasurement,
        likely: Sequence[Component],
        clutter: float,
        unseen: float,
        unit: float,
    ) -> FloatArray:
        """Return the log likelihood of a scan with each error, up to a constant."""
        values, pose, model = member.values, member.pose, member.sensor.measurement
        means = np.array([item.density.mean for item in likely])
        covariances = np.array([item.density.covariance for item in likely])
        errors = model.residual(values, model.measure(means, pose)[:, None])
        # |dx/dz| takes the density of undetected targets to measurement space.
        volume = np.abs(values[:, 0]) ** (values.shape[1] - 1)
        if values.shape[1] == 3:
            volume *= np.cos(values[:, 2])
        probability = np.minimum(member.sensor.detection.probability(means, pose), MOST_PROBABLE)
        detected = probability * [item.existence for item in likely]
        odds = (detected / (1.0 - detected))[:, None] / (clutter + unseen * volume)
        logs = np.empty(len(LEVELS))
        _log_sums(
            errors,
            model.jacobian(means, pose),
            covariances,
            member.covariances,
            member.pose_error**2 + np.square(unit * LEVELS),
            odds,
            logs,
        )
        return logs

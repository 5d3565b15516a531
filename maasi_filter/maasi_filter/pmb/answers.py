"""Whether a place answers as often as a target would, or as rarely as a reflection."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray

# Shares of the believed pi with which a place may answer.
RATES = np.array([1.0, 0.7, 0.5, 0.35, 0.2])
# Those with which all targets may, if pi is not as believed, and their probabilities beforehand.
COMMON = RATES[:3]
PRIOR = np.array([0.9, 0.05, 0.05])
# A reflection answers at most this often, compared with a target.
MOST_OF_REFLECTION = 0.5
# Probability beforehand that a place that answers is one.
REFLECTIONS = 0.1

# By the rate of targets and that of a place: weights of what a place is.
_TARGET = (1.0 - REFLECTIONS) * np.eye(len(COMMON), len(RATES))
_RARE = MOST_OF_REFLECTION * COMMON[:, None] >= RATES
_REFLECTION = REFLECTIONS * _RARE / _RARE.sum(axis=1, keepdims=True)


@njit(cache=True, error_model='numpy')
def add_look(answers, detected, missed):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Add the log likelihood of a look with each rate to `answers` (k,).

    `detected` is p_D as it is believed, `missed` the probability that the place did not answer.
    """
    for k in range(len(RATES)):
        answers[k] += missed * math.log1p(-RATES[k] * detected)
        answers[k] += (1.0 - missed) * math.log(RATES[k])


def rate_of_targets(answers: Sequence[FloatArray], existence: Sequence[float]) -> FloatArray:
    """Return the probabilities of COMMON, from the answers of all places that may be targets."""
    if not len(answers):
        return PRIOR
    logs = np.array(answers)
    peaks = logs.max(axis=1, keepdims=True)
    fits = np.log(np.exp(logs - peaks) @ (_TARGET + _REFLECTION).T)
    sums = np.array(existence) @ fits + np.log(PRIOR)
    weights = np.exp(sums - sums.max())
    return np.asarray(weights / weights.sum())


@njit(cache=True, error_model='numpy')
def reflects(answers, rates):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the probability that a place is a reflection, from its answers and those of all."""
    peak = answers.max()
    target = 0.0
    reflection = 0.0
    for k in range(len(answers)):
        likelihood = math.exp(answers[k] - peak)
        for c in range(len(rates)):
            target += rates[c] * _TARGET[c, k] * likelihood
            reflection += rates[c] * _REFLECTION[c, k] * likelihood
    return reflection / (target + reflection)

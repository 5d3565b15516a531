"""Whether a place answers as often as a target would, or as rarely as a reflection."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

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


def log_answers(detected: float, missed: float) -> FloatArray:
    """Return the log likelihood of a look with each rate, (k,).

    Parameters
    ----------
    detected : float
        p_D, as it is believed.
    missed : float
        Probability that the place did not answer.
    """
    return missed * np.log1p(-RATES * detected) + (1.0 - missed) * np.log(RATES)


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


def reflects(answers: FloatArray, rates: FloatArray) -> float:
    """Return the probability that a place is a reflection, from its answers and those of all."""
    likelihoods = np.exp(answers - answers.max())
    target, reflection = rates @ _TARGET @ likelihoods, rates @ _REFLECTION @ likelihoods
    return float(reflection / (target + reflection))

"""Resolved weights of the objective."""

from __future__ import annotations

from typing import NamedTuple

from maasi_planner.settings import PlannerSettings


class Weights(NamedTuple):
    """Resolved settings of the objective."""

    information: bool
    alpha: float
    beta: float
    control: float
    per_distance: bool
    arrival: bool
    present: bool
    own: bool
    extend: bool


def resolve(settings: PlannerSettings) -> Weights:
    """Return the weights of settings."""
    information = settings.objective == 'information'

    def given(value: float | None, paper: float, other: float) -> float:
        if value is not None:
            return value
        return other if information else paper

    return Weights(
        information=information,
        alpha=settings.alpha,
        beta=given(settings.beta, 0.5, 1.0),
        control=given(settings.control_weight, 1.0, 1e-6),
        per_distance=settings.normalisation == 'distance',
        arrival=bool(given(settings.measure_at_arrival, False, True)),
        present=bool(given(settings.count_present, True, False)),
        own=settings.own_measurement is not False,
        extend=settings.extension == 'measuring',
    )

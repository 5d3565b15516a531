"""The report of a search for targets as plain values, and in words."""

from __future__ import annotations

import math
from typing import Any

from maasi_filter.arrays import FloatArray
from maasi_sim.run.report_files import END_REASONS, ending, identity, pace, path_length
from maasi_sim.targets.tally import FoundCount, TargetRecord


def build_report(record: TargetRecord) -> dict[str, Any]:
    """Return the report of a run as plain values; nothing in it is infinite or not a number."""
    scores = record.scores()
    complete = _completion(record)
    true = dict(scores.match.pairs)
    return {
        **identity(record, 'targets'),
        'targets': [_numbers(position) for position in record.truth],
        'found': [
            {
                'id': target.id,
                'position': _numbers(target.position),
                'covariance': [_numbers(row) for row in target.covariance],
                'agent': target.robot,
                'measurement': target.measurement,
                'time': target.time,
                'class_id': target.label.class_id,
                'score': target.label.score,
                'identity': target.label.identity,
                'target': true.get(index),
            }
            for index, target in enumerate(record.found)
        ],
        'true_found': scores.match.true_found,
        'missed': scores.match.missed,
        'false_found': scores.match.false_found,
        'rmse': _number(scores.match.rmse),
        'gospa': {
            part: getattr(scores.gospa, part)
            for part in ('total', 'localisation', 'missed', 'false')
        },
        'measurements': record.measurements,
        'measurements_to_find_all': complete.measurements if complete else None,
        'time_to_find_all': complete.time if complete else None,
        'decisions': record.decisions,
        'distance': {n: _number(path_length(way)) for n, way in record.trajectories.items()},
        **ending(record),
        'scoring': {'radius': scores.radius, 'c': scores.radius, 'p': scores.order},
    }


def summary(report: dict[str, Any]) -> str:
    """Return the report in a few lines."""
    targets = len(report['targets'])
    found = f'{report["true_found"]} of {targets} targets found'
    if report['false_found']:
        found += f', {report["false_found"]} false'
    if report['rmse'] is not None:
        found += f', RMSE {report["rmse"]:.3g} m'
    measurements = sum(report['measurements'].values())
    lines = [
        f'{found} (ended: {END_REASONS.get(report["end_reason"], report["end_reason"])})',
        f'{measurements} measurements, {report["decisions"]} decisions',
    ]
    if report['measurements_to_find_all'] is not None and targets:
        lines[1] += (
            f'; all found after {report["measurements_to_find_all"]} measurements and '
            f'{report["time_to_find_all"]:.1f} s'
        )
    return '\n'.join(lines + pace(report))


def _completion(record: TargetRecord) -> FoundCount | None:
    """Return when all targets were found and stayed so."""
    complete = None
    for progress in reversed(record.progress if len(record.truth) else []):
        if progress.true_found < len(record.truth):
            break
        complete = progress
    return complete


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _numbers(values: FloatArray) -> list[float | None]:
    return [_number(value) for value in values]

"""The report of a search for targets, as plain values and text."""

import math
from collections import deque
from itertools import takewhile
from typing import Any

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.unexplored_map import UnexploredMap
from maasi_filter.wording import counted, number
from maasi_planner.candidates import map_spacing
from maasi_sim.run.log import RunLog
from maasi_sim.run.report_files import finite, summary, whole_report


def build_report(log: RunLog) -> dict[str, Any]:
    """Return the report of a run as plain values."""
    scores, total = log.scores, len(log.truth)
    # The first update since which all targets are found.
    stayed = list(takewhile(lambda item: item.true_found == total, log.progress[::-1]))
    complete = stayed[-1] if total and stayed else None
    true = dict(scores.match.pairs)
    found = [
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
        for index, target in enumerate(log.found_targets)
    ]
    parts = ('total', 'localisation', 'missed', 'false')
    content = {
        'targets': [_numbers(position) for position in log.truth],
        'found': found,
        'true_found': scores.match.true_found,
        'missed': scores.match.missed,
        'false_found': scores.match.false_found,
        'rmse': finite(scores.match.rmse),
        'gospa': {part: getattr(scores.gospa, part) for part in parts},
        'measurements': dict(sorted(log.measurements.items())),
        'measurements_to_find_all': complete.measurements if complete else None,
        'time_to_find_all': complete.time if complete else None,
        'decisions': sum(map(len, log.waypoints.values())),
        'scoring': {'radius': scores.radius, 'c': scores.radius, 'p': scores.order},
    }
    return whole_report(log, 'targets', content)


def explored_after(log: RunLog) -> UnexploredMap:
    """Return the map of unexplored area after all measurements and statements of persons."""
    scenario, area = log.scenario, Area(log.scenario.environment)
    sensors = {
        name: robot.sensor.build(name, scenario.dimension)
        for name, robot in scenario.robots.items()
    }
    spacing, _ = map_spacing(area.bounds, sensors.values())
    explored = UnexploredMap(area, scenario.filter.exploration_spacing or spacing)
    left = {name: deque(poses) for name, poses in log.measured_from.items()}

    def measure(until: float) -> None:
        for name, poses in left.items():
            while poses and poses[0][0] <= until:
                explored.update(sensors[name].detection, poses.popleft()[1])

    for report in log.reports():
        measure(report.time)
        explored.use(report)
    measure(math.inf)
    return explored


def target_summary(report: dict[str, Any]) -> str:
    """Return the report in a few lines."""
    found = f'{report["true_found"]} of {len(report["targets"])} targets found'
    if report['false_found']:
        found += f', {report["false_found"]} false'
    if report['rmse'] is not None:
        found += f', RMSE {number(report["rmse"])} m'
    measurements = sum(report['measurements'].values())
    counts = f'{counted(measurements, "measurement")}, {counted(report["decisions"], "decision")}'
    if report['time_to_find_all'] is not None:
        counts += f'; all found after {to_find_all(report)}'
    return summary(report, found, counts)


def to_find_all(report: dict[str, Any]) -> str:
    """Return the measurements and time to find all targets, as text."""
    time, measurements = report['time_to_find_all'], report['measurements_to_find_all']
    return '-' if time is None else f'{counted(measurements, "measurement")} and {time:.1f} s'


def _numbers(values: FloatArray) -> list[float | None]:
    return [finite(value) for value in values]

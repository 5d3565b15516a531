"""The report of a search of buildings as plain values, and in words."""

from __future__ import annotations

from typing import Any

import numpy as np

from maasi_sim.buildings.observer import CuboidRecord
from maasi_sim.run.report_files import END_REASONS, ending, identity, pace, path_length


def build_cuboid_report(record: CuboidRecord) -> dict[str, Any]:
    """Return the report of a run as plain values; nothing in it is infinite or not a number.

    There are no targets; visited cuboids count as found, `cuboids` in the report.
    """
    mission = record.mission
    first: dict[int, Any] = {}
    for shot in record.snapshots:
        first.setdefault(shot.cuboid, shot)
    numbers = dict.fromkeys(record.scenario.names(), 0)
    for shot in record.snapshots:
        numbers[shot.agent] += 1
    total = len(mission.cells)
    chances = [shot.detection_probability for shot in record.snapshots]
    cuts = sum(
        mission.way_hits(begin, end)
        for path in record.trajectories.values()
        for begin, end in zip(path[:-1, 1:], path[1:, 1:])
    )
    complete = record.completed
    return {
        **identity(record, 'buildings'),
        'cuboids': {
            'total': total,
            'visited': len(first),
            'missed': sorted(set(range(total)) - set(first)),
            'lost': [
                {'object': cell.target, 'face': cell.face, 'reason': reason}
                for cell, reason in mission.lost
            ],
        },
        'missed': total - len(first),
        'coverage': mission.coverage * len(first) / total,
        'snapshots': [
            {
                'cuboid': shot.cuboid,
                'object': mission.cells[shot.cuboid].target,
                'face': mission.cells[shot.cuboid].face,
                'agent': shot.agent,
                'time': shot.time,
                'position': shot.position.tolist(),
                'direction': shot.direction.tolist(),
                'distance': shot.distance,
                'detection_probability': shot.detection_probability,
            }
            for shot in record.snapshots
        ],
        'least_detection_probability': min(chances) if chances else None,
        'measurements': numbers,
        'measurements_to_find_all': len(record.snapshots) if complete else None,
        'time_to_find_all': complete.time if complete else None,
        'decisions': sum(record.choices.values()),
        'choices': dict(sorted(record.choices.items())),
        'solve_time': (
            {
                'median': float(np.median(record.solve_times)),
                'largest': float(record.solve_times.max()),
            }
            if len(record.solve_times)
            else None
        ),
        'most_heard': record.most_heard,
        'collisions': int(cuts),
        'distance': {name: path_length(path) for name, path in record.trajectories.items()},
        **ending(record),
    }


def cuboid_summary(report: dict[str, Any]) -> str:
    """Return the report in a few lines."""
    cuboids = report['cuboids']
    reason = END_REASONS.get(report['end_reason'], report['end_reason'])
    if report['end_reason'] == 'all_found':
        reason = 'all cuboids visited'
    lines = [f'{cuboids["visited"]} of {cuboids["total"]} cuboids visited (ended: {reason})']
    lines.append(
        f'{len(report["snapshots"])} snapshots, {report["decisions"]} decisions, '
        f'{report["collisions"]} collisions'
    )
    if report['time_to_find_all'] is not None:
        lines[-1] += f'; all visited after {report["time_to_find_all"]:.1f} s'
    return '\n'.join(lines + pace(report))

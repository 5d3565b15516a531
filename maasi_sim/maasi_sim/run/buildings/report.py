"""The report of a search of buildings as plain values, and in words."""

from typing import Any

import numpy as np

from maasi_sim.run.buildings.observer import CuboidRecord
from maasi_sim.run.report_files import summary, whole_report


def build_cuboid_report(record: CuboidRecord) -> dict[str, Any]:
    """Return the report of a run as plain values; visited cuboids count as found."""
    mission, shots = record.mission, record.snapshots
    visited = {shot['cuboid'] for shot in shots}
    total = len(mission.cells)
    cuts = sum(
        mission.way_hits(begin, end)
        for path in record.trajectories.values()
        for begin, end in zip(path[:-1, 1:], path[1:, 1:])
    )
    times = record.solve_times
    complete = record.completed
    content = {
        'cuboids': {
            'total': total,
            'visited': len(visited),
            'missed': sorted(set(range(total)) - visited),
            'lost': [
                {'object': cell.target, 'face': cell.face, 'reason': reason}
                for cell, reason in mission.lost
            ],
        },
        'missed': total - len(visited),
        'coverage': mission.coverage * len(visited) / total,
        'snapshots': shots,
        'least_detection_probability': min(
            (shot['detection_probability'] for shot in shots), default=None
        ),
        'measurements': {
            name: sum(shot['agent'] == name for shot in shots) for name in record.scenario.names()
        },
        'measurements_to_find_all': len(shots) if complete else None,
        'time_to_find_all': complete.time if complete else None,
        'decisions': sum(record.choices.values()),
        'choices': dict(sorted(record.choices.items())),
        'solve_time': {'median': float(np.median(times)), 'largest': float(times.max())}
        if len(times)
        else None,
        'most_heard': record.most_heard,
        'collisions': int(cuts),
    }
    return whole_report(record, 'buildings', content)


def cuboid_summary(report: dict[str, Any]) -> str:
    """Return the report in a few lines."""
    cuboids = report['cuboids']
    counts = (
        f'{len(report["snapshots"])} snapshots, {report["decisions"]} decisions, '
        f'{report["collisions"]} collisions'
    )
    if report['time_to_find_all'] is not None:
        counts += f'; all visited after {report["time_to_find_all"]:.1f} s'
    return summary(report, f'{cuboids["visited"]} of {cuboids["total"]} cuboids visited', counts)

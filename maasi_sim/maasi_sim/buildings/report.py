"""The report of a search of buildings: `report.json`, and a picture of it in 3D."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from maasi_sim.buildings.observer import CuboidRecord
from maasi_sim.buildings.picture import draw_mission, legend
from maasi_sim.machine import this_machine
from maasi_sim.run.report import END_REASONS, path_length

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def build_cuboid_report(record: CuboidRecord) -> dict[str, Any]:
    """Return the report of a run as plain values; nothing in it is infinite or not a number.

    There are no targets: what is found is cuboids visited, `cuboids` in the report.
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
    wall = record.wall_time
    complete = record.completed
    return {
        'scenario': record.name,
        'seed': record.seed,
        'planner': record.scenario.planner.name,
        'agents': record.scenario.names(),
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
        'end_reason': record.end_reason,
        'wall_time': wall,
        'real_time_factor': record.end_time / wall if wall > 0.0 else None,
        'machine': this_machine(),
        'events': record.events,
    }


def write_cuboid_report(record: CuboidRecord, folder: Path) -> dict[str, Any]:
    """Write `report.json` and `report.png` into a folder and return the report."""
    report = build_cuboid_report(record)
    from maasi_sim.run.run_folder import write_text, write_whole

    text = json.dumps(report, indent=2, allow_nan=False)
    write_text(folder / 'report.json', text + '\n')
    figure = plot_cuboid_report(record)
    write_whole(folder / 'report.png', lambda path: figure.savefig(path, dpi=110))
    return report


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
    if report['real_time_factor'] is not None:
        lines.append(
            f'{report["wall_time"]:.1f} s of wall time, '
            f'{report["real_time_factor"]:.1f} times real time'
        )
    return '\n'.join(lines)


def plot_cuboid_report(record: CuboidRecord) -> Figure:
    """Return a picture: the mission in 3D, and cuboids visited and robots over time."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 7.2), layout='constrained')
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, width_ratios=[1.9, 1.0])
    space = figure.add_subplot(grid[:, 0], projection='3d')
    visited = {shot.cuboid for shot in record.snapshots}
    paths = {name: path[:, 1:] for name, path in record.trajectories.items()}
    draw_mission(space, record.mission, paths, visited)
    legend(space)
    over = figure.add_subplot(grid[0, 1])
    seen: set[int] = set()
    times, counts = [0.0], [0]
    for shot in record.snapshots:
        seen.add(shot.cuboid)
        times.append(shot.time)
        counts.append(len(seen))
    over.step(times, counts, where='post', color='#0072B2')
    over.axhline(len(record.mission.cells), color='#222222', lw=1.0, ls='--')
    over.set_ylabel('cuboids visited')
    active = figure.add_subplot(grid[1, 1], sharex=over)
    active.step(record.active[:, 0], record.active[:, 1], where='post', color='#009E73')
    active.set_ylim(0, len(record.scenario.robots) + 0.5)
    active.set_ylabel('robots that search')
    active.set_xlabel('time [s]')
    words = figure.add_subplot(grid[2, 1])
    words.set_axis_off()
    report = build_cuboid_report(record)
    lines = [
        f'visited: {report["cuboids"]["visited"]} of {report["cuboids"]["total"]}, '
        f'at {report["time_to_find_all"] or math.nan:.0f} s',
        f'least p_d of a snapshot: {report["least_detection_probability"] or math.nan:.3g}',
        f'collisions: {report["collisions"]}',
        *(f'{key}: {number} decisions' for key, number in report['choices'].items()),
        *(
            f'{e["time"]:.0f} s: {e.get("agent", e.get("node"))} {e["event"]}'
            for e in record.events[:4]
        ),
    ]
    words.text(0.0, 1.0, '\n'.join(lines), va='top', fontsize=9)
    title = f'{record.name}   seed {record.seed}   planner {record.scenario.planner.name}'
    figure.suptitle(title, fontsize=13, fontweight='bold')
    return figure

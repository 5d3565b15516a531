"""The figure of a search of buildings: the mission in 3D, and cuboids visited over time."""

from __future__ import annotations

import math

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from maasi_sim.buildings.observer import CuboidRecord
from maasi_sim.buildings.picture import draw_mission, legend
from maasi_sim.buildings.report import build_cuboid_report
from maasi_sim.run.report_files import title


def plot_cuboid_report(record: CuboidRecord) -> Figure:
    """Return a picture: the mission in 3D, and cuboids visited and robots over time."""
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
    figure.suptitle(title(record), fontsize=13, fontweight='bold')
    return figure

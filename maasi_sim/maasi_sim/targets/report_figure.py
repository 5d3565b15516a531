"""The figure of a search for targets: the search, and targets found over measurements."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from maasi_sim.run.report_files import END_REASONS, title
from maasi_sim.targets.report import build_report
from maasi_sim.targets.target_record import TargetRecord

FloatArray = NDArray[np.float64]

# Palette for colour-blind readers (Okabe and Ito).
_COLOURS = ('#0072B2', '#E69F00', '#009E73', '#CC79A7', '#56B4E9', '#8C564B')
_TRUE, _FOUND, _FALSE, _PALE = '#222222', '#D62728', '#7B3294', '#9A9A9A'
_SIGMAS = 3.0


def plot_report(record: TargetRecord) -> Figure:
    """Return a picture: map or 3D view of the search, and targets found over measurements."""
    figure = Figure(figsize=(12.5, 7.2), layout='constrained')
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.65, 1.0], height_ratios=[1.5, 1.0])
    if record.scenario.dimension == 2:
        world = figure.add_subplot(grid[:, 0])
        _plot_map(world, record)
    else:
        world = figure.add_subplot(grid[:, 0], projection='3d')
        _plot_space(world, record)
    handles, labels = world.get_legend_handles_labels()
    unique = dict(zip(labels, handles))
    world.legend(
        unique.values(),
        unique.keys(),
        loc='upper center',
        bbox_to_anchor=(0.5, -0.06),
        ncols=4,
        fontsize=9,
        frameon=False,
    )
    _plot_progress(figure.add_subplot(grid[0, 1]), record)
    _write_summary(figure.add_subplot(grid[1, 1]), record)
    figure.suptitle(title(record), fontsize=13, fontweight='bold')
    return figure


def _colours(record: TargetRecord) -> dict[str, str]:
    names = record.scenario.names()
    return {name: _COLOURS[index % len(_COLOURS)] for index, name in enumerate(names)}


def _pairs(record: TargetRecord) -> tuple[FloatArray, list[int], list[int]]:
    positions = np.array([target.position for target in record.found], dtype=float)
    right = sorted(found for found, _ in record.scores().match.pairs)
    wrong = [index for index in range(len(record.found)) if index not in right]
    return positions.reshape(-1, record.scenario.dimension), right, wrong


def _plot_map(axes: Axes, record: TargetRecord) -> None:
    bounds = record.scenario.environment.array()
    low, size = bounds[:, 0], bounds[:, 1] - bounds[:, 0]
    axes.add_patch(Rectangle((low[0], low[1]), size[0], size[1], fc='#FAFAF7', ec='#B0B0B0', lw=1))
    for obstacle in record.scenario.environment.obstacles:
        axes.add_patch(
            Circle(
                (obstacle.centre[0], obstacle.centre[1]),
                obstacle.radius,
                fc='#C9C3B8',
                ec='#8A8478',
                label='obstacle',
            )
        )
    for name, colour in _colours(record).items():
        path = record.trajectories[name]
        axes.plot(path[:, 1], path[:, 2], '-', color=colour, lw=1.3, alpha=0.85, label=name)
        places = record.measured_at[name]
        axes.plot(places[:, 0], places[:, 1], '.', color=colour, ms=3, alpha=0.45)
        points = record.waypoints[name]
        axes.plot(points[:, 0], points[:, 1], '+', color=colour, ms=8, mew=1.2)
        if len(path):
            axes.plot(path[0, 1], path[0, 2], 's', color=colour, ms=8, mec='white')
            axes.plot(path[-1, 1], path[-1, 2], 'o', color=colour, ms=8, mec='white')
    axes.plot([], [], '+', color=_PALE, ms=8, label='waypoint')
    axes.plot([], [], '.', color=_PALE, ms=5, label='measurement')
    axes.plot([], [], 's', color=_PALE, ms=7, label='start')
    axes.plot([], [], 'o', color=_PALE, ms=7, label='end')
    if len(record.truth):
        axes.plot(
            record.truth[:, 0],
            record.truth[:, 1],
            'D',
            mfc='none',
            mec=_TRUE,
            ms=10,
            mew=1.4,
            label='true target',
        )
    positions, right, wrong = _pairs(record)
    axes.plot(
        positions[right, 0], positions[right, 1], 'D', color=_FOUND, ms=5, label='found target'
    )
    if wrong:
        axes.plot(
            positions[wrong, 0], positions[wrong, 1], 'X', color=_FALSE, ms=9, label='false target'
        )
    for target in record.found:
        lengths, turn = _axes_of(target.covariance)
        axes.add_patch(
            Ellipse(
                (target.position[0], target.position[1]),
                2 * lengths[0],
                2 * lengths[1],
                angle=math.degrees(math.atan2(turn[1, 0], turn[0, 0])),
                fc='none',
                ec=_FOUND,
                lw=1.2,
                label=f'{_SIGMAS:g} sigma',
            )
        )
    margin = 0.03 * size.max()
    axes.set_xlim(bounds[0, 0] - margin, bounds[0, 1] + margin)
    axes.set_ylim(bounds[1, 0] - margin, bounds[1, 1] + margin)
    axes.set_aspect('equal')
    axes.set_xlabel('x [m]')
    axes.set_ylabel('y [m]')
    axes.spines[['top', 'right']].set_visible(False)


def _plot_space(axes: Any, record: TargetRecord) -> None:
    bounds = record.scenario.environment.array()
    for name, colour in _colours(record).items():
        path = record.trajectories[name]
        axes.plot(*path[:, 1:].T, '-', color=colour, lw=1.3, alpha=0.85, label=name)
        axes.plot(*record.measured_at[name].T, '.', color=colour, ms=3, alpha=0.5)
        axes.plot(*record.waypoints[name].T, '+', color=colour, ms=8, mew=1.2)
        if len(path):
            axes.plot(*path[:1, 1:].T, 's', color=colour, ms=7, mec='white')
            axes.plot(*path[-1:, 1:].T, 'o', color=colour, ms=7, mec='white')
    axes.plot([], [], [], '+', color=_PALE, ms=8, label='waypoint')
    axes.plot([], [], [], '.', color=_PALE, ms=5, label='measurement')
    axes.plot([], [], [], 's', color=_PALE, ms=7, label='start')
    axes.plot([], [], [], 'o', color=_PALE, ms=7, label='end')
    floor = bounds[2, 0]
    for point in record.truth:
        # A vertical line to the floor shows the position in depth.
        axes.plot([point[0]] * 2, [point[1]] * 2, [floor, point[2]], '-', color=_PALE, lw=0.6)
    if len(record.truth):
        axes.plot(*record.truth.T, 'D', mfc='none', mec=_TRUE, ms=9, mew=1.4, label='true target')
    positions, right, wrong = _pairs(record)
    axes.plot(*positions[right].T, 'D', color=_FOUND, ms=5, label='found target')
    if wrong:
        axes.plot(*positions[wrong].T, 'X', color=_FALSE, ms=9, label='false target')
    for target in record.found:
        lengths, turn = _axes_of(target.covariance)
        for length, direction in zip(lengths, turn.T):
            ends = target.position + np.outer([-length, length], direction)
            axes.plot(*ends.T, '-', color=_FOUND, lw=1.2, label=f'{_SIGMAS:g} sigma')
    for obstacle in record.scenario.environment.obstacles:
        _plot_obstacle(axes, np.array(obstacle.centre), obstacle.radius, bounds)
    axes.set_xlim(*bounds[0])
    axes.set_ylim(*bounds[1])
    axes.set_zlim(*bounds[2])
    axes.set_box_aspect(bounds[:, 1] - bounds[:, 0], zoom=0.92)
    axes.set_xlabel('x [m]')
    axes.set_ylabel('y [m]')
    axes.set_zlabel('z [m]')
    axes.view_init(elev=24, azim=-58)


def _plot_obstacle(axes: Any, centre: FloatArray, radius: float, bounds: FloatArray) -> None:
    """Draw a sphere, or an upright cylinder for a centre of two coordinates."""
    around = np.linspace(0.0, 2.0 * math.pi, 25)[:, None]
    if len(centre) == 2:
        heights = bounds[2][None, :]
        x = centre[0] + radius * np.cos(around) + 0.0 * heights
        y = centre[1] + radius * np.sin(around) + 0.0 * heights
        z = heights + 0.0 * around
    else:
        down = np.linspace(0.0, math.pi, 13)[None, :]
        x = centre[0] + radius * np.cos(around) * np.sin(down)
        y = centre[1] + radius * np.sin(around) * np.sin(down)
        z = centre[2] + radius * np.cos(down) + 0.0 * around
    axes.plot_surface(x, y, z, color='#C9C3B8', alpha=0.5, linewidth=0)


def _axes_of(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return half axes of the ellipse of so many sigma, and their directions as columns."""
    values, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return _SIGMAS * np.sqrt(np.maximum(values, 0.0)), directions


def _plot_progress(axes: Axes, record: TargetRecord) -> None:
    counts = [0, *(item.measurements for item in record.progress)]
    right = [0, *(item.true_found for item in record.progress)]
    every = [0, *(item.found for item in record.progress)]
    if any(number > true for number, true in zip(every, right)):
        axes.step(counts, every, where='post', color=_FALSE, lw=1.0, label='declared')
    axes.step(counts, right, where='post', color=_FOUND, lw=2.0, label='found')
    axes.axhline(len(record.truth), color=_TRUE, lw=1.0, ls='--', label='true targets')
    axes.set_xlim(0, max(counts[-1], 1))
    axes.set_ylim(0, max(len(record.truth), max(every), 1) * 1.08)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel('measurements, all robots')
    axes.set_ylabel('targets')
    axes.set_title('Targets found over measurements', fontsize=11)
    axes.grid(color='#E6E6E6', lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[['top', 'right']].set_visible(False)
    axes.legend(loc='lower right', fontsize=9, frameon=False)


def _write_summary(axes: Axes, record: TargetRecord) -> None:
    report = build_report(record)
    rmse = '-' if report['rmse'] is None else f'{report["rmse"]:.3g} m'
    complete = '-'
    if report['measurements_to_find_all'] is not None:
        complete = (
            f'{report["measurements_to_find_all"]} measurements, {report["time_to_find_all"]:.1f} s'
        )
    rows = [
        ('found', f'{report["true_found"]} of {len(report["targets"])}'),
        ('false', str(report['false_found'])),
        ('RMSE', rmse),
        ('GOSPA', f'{report["gospa"]["total"]:.3g} m (c = {report["scoring"]["c"]:.3g} m)'),
        ('all found after', complete),
        ('decisions', str(report['decisions'])),
    ]
    rows += [
        (name, f'{report["measurements"][name]} measurements, {report["distance"][name]:.1f} m')
        for name in report['agents'][:4]
    ]
    reason = END_REASONS.get(report['end_reason'], report['end_reason'])
    rows.append(('ended', f'{reason}, at {record.end_time:.1f} s'))
    for event in record.events[:3]:
        who = event.get('agent', event.get('node', ''))
        rows.append((f'{event["time"]:.1f} s', f'{who} {event["event"]}'))
    axes.set_axis_off()
    for index, (key, value) in enumerate(rows):
        height = 1.0 - (index + 0.5) / max(len(rows), 10)
        axes.text(0.0, height, key, color='#666666', fontsize=10, va='center')
        axes.text(0.34, height, value, fontsize=10, va='center')

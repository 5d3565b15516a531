"""The report figure of a search for targets."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from maasi_filter.arrays import FloatArray
from maasi_filter.colours import FOUND, robot_colours
from maasi_filter.geometry.area import Area
from maasi_filter.models.detection import DetectionModel
from maasi_filter.models.pose import Pose
from maasi_filter.unexplored_map import UnexploredMap
from maasi_filter.wording import counted, number
from maasi_sim.run.log import RunLog
from maasi_sim.run.report_files import reason_of_end
from maasi_sim.run.report_panels import (
    MARGIN,
    PALE,
    UNSEEN,
    MapView,
    draw_ground,
    draw_report,
    ellipse,
)
from maasi_sim.run.targets.report import build_report, explored_after, to_find_all

_TRUE, _MISSED, _FALSE = '#222222', '#D62728', '#E6007E'
_SIGMAS = 3.0
# Smallest half axis of a drawn ellipse, as a share of the longest side.
_LEAST = {2: 0.012, 3: 0.022}
_VIEW_GRID = 160  # points per axis of a field of view


def plot_report(record: RunLog) -> Figure:
    """Return a figure of the search from above (in 3D also from the sides) and its progress."""
    scenario = record.scenario
    area = Area(scenario.environment)
    bounds = area.bounds
    colours = robot_colours(scenario.names())
    detections = {
        name: scenario.robots[name].sensor.build(name, scenario.dimension).detection
        for name in colours
    }
    explored = explored_after(record)

    def draw_map(view: MapView) -> None:
        draw_explored(view, explored, bounds)
        draw_ground(view, area, bounds)
        for name, colour in colours.items():
            waypoints = view.points([place for _, place in record.waypoints.get(name, ())])
            view.axes.plot(*waypoints, '+', color=colour, ms=8, mew=1.3)
            if record.measured_from.get(name):
                _, pose = record.measured_from[name][-1]
                _draw_field(view, detections[name], pose, colour, bounds)
        _draw_targets(view, record, bounds)
        view.axes.plot([], [], '+', color=PALE, ms=8, label='waypoint')
        view.axes.plot([], [], ':', color=PALE, lw=1.5, label='field of view at the end')

    return draw_report(
        record,
        colours,
        bounds,
        draw_map,
        [
            ('', 1.0, lambda axes: _draw_progress(axes, record, True)),
            ('measurements, all robots', 1.0, lambda axes: _draw_progress(axes, record, False)),
        ],
        'Targets found',
        _rows(record),
    )


def draw_explored(view: MapView, explored: UnexploredMap, bounds: FloatArray) -> None:
    """Shade the unexplored area: e, in 3D its mean along the line of sight."""
    hidden = tuple(axis for axis in range(explored.dimension) if axis not in view.plane)
    lower, step, shown = explored.shown()
    shown = np.maximum(shown, 0.0)
    values = shown.mean(axis=hidden) if hidden else shown
    if view.plane[0] < view.plane[1]:
        values = values.T
    right, up = (lower[axis] + step[axis] * np.arange(shown.shape[axis]) for axis in view.plane)
    shades = LinearSegmentedColormap.from_list('unseen', ['#FFFFFF', UNSEEN])
    view.axes.pcolormesh(
        right, up, values, cmap=shades, vmin=0.0, vmax=1.0, shading='gouraud', zorder=0
    )
    low, high = bounds[list(view.plane)].T
    if not explored.area.shapes['area'] or 2 in view.plane:
        frame = Rectangle((low[0], low[1]), *(high - low), fc='none', ec='#B0B0B0', lw=1.0)
        view.axes.add_patch(frame)
    view.axes.plot([], [], 's', color=UNSEEN, ms=9, label='not explored')


def _draw_field(
    view: MapView, detection: DetectionModel, pose: Pose, colour: str, bounds: FloatArray
) -> None:
    """Draw the contour at half of a robot's largest detection probability."""
    right, up = (np.linspace(bounds[axis, 0], bounds[axis, 1], _VIEW_GRID) for axis in view.plane)
    places = np.tile(pose.position[: len(bounds)], (_VIEW_GRID**2, 1))
    grid = np.meshgrid(right, up)
    for axis, coordinates in zip(view.plane, grid):
        places[:, axis] = coordinates.ravel()
    values = detection.probability(places, pose).reshape(grid[0].shape)
    if values.max() > 0.0:
        style: dict[str, Any] = {'linewidths': 1.5, 'linestyles': 'dotted', 'zorder': 2}
        view.axes.contour(*grid, values, levels=[0.5 * values.max()], colors=[colour], **style)


def _draw_targets(view: MapView, record: RunLog, bounds: FloatArray) -> None:
    axes, width, found, truth = view.axes, len(bounds), record.found_targets, record.truth
    positions = np.array([item.position for item in found], float).reshape(-1, width)
    pairs = record.scores.match.pairs
    right = [index for index, _ in pairs]
    wrong = np.setdiff1d(np.arange(len(positions)), right)
    missed = np.setdiff1d(np.arange(len(truth)), [true for _, true in pairs])
    least = _LEAST[width] * float(np.ptp(bounds, axis=1).max())
    enlarged = False
    for index, target in enumerate(found):
        covariance = target.covariance[np.ix_(view.plane, view.plane)]
        enlarged |= _SIGMAS * math.sqrt(max(np.linalg.eigvalsh(covariance)[0], 0.0)) < least
        place = (target.position[view.plane[0]], target.position[view.plane[1]])
        style: dict[str, Any] = {'ec': _FALSE if index in wrong else FOUND, 'lw': 1.3}
        axes.add_patch(ellipse(place, covariance, _SIGMAS, least, zorder=5, **style))
    sigmas = f'{_SIGMAS:g} sigma' + (f', at least {least:.2g} m' if enlarged else '')
    marks: tuple[tuple[FloatArray, str, dict[str, Any], str], ...] = (
        (truth, 'D', {'mfc': 'none', 'mec': _TRUE, 'ms': 11, 'mew': 1.2}, 'true target'),
        (positions[right], 'D', {'color': FOUND, 'ms': 3.5}, 'found target'),
        (positions[:0], 'o', {'mfc': 'none', 'mec': FOUND, 'ms': 9}, sigmas),
        (truth[missed], 'o', {'mfc': 'none', 'mec': _MISSED, 'ms': 20, 'mew': 3}, 'missed'),
        (positions[wrong], 'X', {'color': _FALSE, 'ms': 14, 'mec': 'white'}, 'false target'),
    )
    for places, marker, style, label in marks:
        if len(places) or label == sigmas:
            points = view.points(places, width)
            axes.plot(*points, marker, ls='none', zorder=7, label=label, **style)


def _draw_progress(axes: Axes, record: RunLog, by_time: bool) -> None:
    progress, number = record.progress, len(record.truth)
    places = [0.0, *(item.time if by_time else item.measurements for item in progress)]
    right = [0, *(item.true_found for item in progress)]
    every = [0, *(item.found for item in progress)]
    if by_time:
        places, right, every = [*places, record.end_time], [*right, right[-1]], [*every, every[-1]]
    if any(found > true for found, true in zip(every, right)):
        axes.step(places, every, where='post', color=_FALSE, lw=1.0, label='including false finds')
    axes.step(places, right, where='post', color=FOUND, lw=2.0, label='found')
    axes.axhline(number, color=_TRUE, lw=1.0, ls='--', label='true targets')
    axes.set_xlim(0.0, MARGIN * max(places[-1], 1.0))
    axes.set_ylim(0.0, max(number, max(every), 1) * 1.08)
    axes.set_ylabel('targets')
    if by_time:
        # Outside of the axes, where it covers no curve.
        above: dict[str, Any] = {'loc': 'lower right', 'bbox_to_anchor': (1.0, 1.0), 'ncol': 3}
        close = {'handlelength': 1.6, 'columnspacing': 1.2, 'borderaxespad': 0.1}
        axes.legend(**above, **close, fontsize=8.5, frameon=False)


def _rows(record: RunLog) -> list[tuple[str, str]]:
    report = build_report(record)
    rmse = '-' if report['rmse'] is None else f'{number(report["rmse"])} m'
    found = f'{report["true_found"]} of {len(report["targets"])}'
    return [
        ('found', f'{found}, {report["missed"]} missed, {report["false_found"]} false'),
        ('RMSE', rmse),
        ('GOSPA', f'{number(report["gospa"]["total"])} m (c = {number(report["scoring"]["c"])} m)'),
        ('all found after', to_find_all(report)),
        ('decisions', str(report['decisions'])),
        *(
            (
                name,
                f'{counted(report["measurements"][name], "measurement")}, '
                f'{number(report["distance"][name])} m travelled',
            )
            for name in report['agents'][:4]
        ),
        ('ended', f'{reason_of_end(report)}, at {record.end_time:.1f} s'),
    ]

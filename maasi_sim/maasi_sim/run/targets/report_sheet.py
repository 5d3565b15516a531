"""The report on one page to print: what a coordinator has found, searched and left."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from datetime import datetime, timezone
from typing import Any

import numpy as np
import shapely
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.figure import Figure

from maasi_filter.colours import FOUND, robot_colours
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.geodesy import geodetic
from maasi_filter.records import FoundTarget
from maasi_filter.unexplored_map import UnexploredMap
from maasi_filter.wording import counted, number
from maasi_sim.run.log import RunLog
from maasi_sim.run.report_files import END_REASONS
from maasi_sim.run.report_panels import MapView, draw_ground, draw_path, ellipse
from maasi_sim.run.targets.coverage import Sector, searched_at_least, sectors
from maasi_sim.run.targets.report_figure import draw_explored

_PAPER = (8.27, 11.69)  # A4 [inch]
_LINE = 0.148  # of a table [inch]
_MOST_FOUND, _MOST_ROBOTS = 27, 9  # lines of tables
_LONGEST = 60  # characters of a name
_SIGMAS, _LEAST = 3.0, 0.006  # of drawn ellipses; their least size relative to the map
_GREY = '#666666'


def report_pdf(record: RunLog, explored: UnexploredMap) -> bytes:
    """Return one page for print as PDF, without data about the true targets."""
    figure = Figure(figsize=_PAPER)
    FigureCanvasPdf(figure)
    parts = sectors(explored)
    _write_head(figure, record, explored)
    _draw_map(figure.add_axes((0.08, 0.455, 0.86, 0.43)), record, explored, parts)
    size = _PAPER[1] * 0.40
    left, right = (
        figure.add_axes((x, 0.015, width, 0.40)) for x, width in ((0.05, 0.5), (0.59, 0.37))
    )
    for axes in (left, right):
        axes.set_axis_off()
        axes.set_xlim(0.0, 1.0)
        axes.set_ylim(size / _LINE, 0.0)
    _write_found(left, record)
    line = _write_sectors(right, parts)
    _write_robots(right, record, line + 1)
    out, facts = (
        io.BytesIO(),
        {'Title': f'{_plain(record.name)}: search report', 'CreationDate': None},
    )
    # Text stays text. Signs that the font lacks are drawn as boxes.
    with rc_context({'pdf.fonttype': 42}), warnings.catch_warnings():
        warnings.filterwarnings('ignore', message=r'Glyph \d+')
        figure.savefig(out, format='pdf', metadata=facts)
    return out.getvalue()


def _plain(text: str, most: int = _LONGEST) -> str:
    shown = ''.join(sign if sign.isprintable() else '?' for sign in text)
    return shown if len(shown) <= most else f'{shown[: most - 3]}...'


def _clock(record: RunLog, time: float, full: bool = False) -> str:
    if record.began is None:
        return f'{time:.1f} s'
    moment = datetime.fromtimestamp(record.began + time, timezone.utc)
    return f'{moment:%Y-%m-%d %H:%M:%S} UTC' if full else f'{moment:%H:%M:%S}'


def _write_head(figure: Figure, record: RunLog, explored: UnexploredMap) -> None:
    (once, twice), size = searched_at_least(record, explored)
    end, dimension = _clock(record, record.end_time, full=True), explored.dimension
    when = f'The search took {end}. Times are seconds since the first step.'
    if record.began is not None:
        when = f'From {_clock(record, 0.0, full=True)} to {end}. Times are UTC.'
    parts = [f'{100.0 * x:.0f} % ({_size(x * size, dimension)})' for x in (once, twice)]
    lines = [
        f'{when} Ended: {_reason(record)}.',
        f'{counted(len(record.found_targets), "target")} found. Searched once: {parts[0]}, '
        f'twice: {parts[1]} of {_size(size, dimension)}. Cumulative probability of success: '
        f'{100.0 * explored.explored_fraction():.1f} %.',
    ]
    _text(figure, 0.05, 0.965, f'Search report: {_plain(record.name)}', 14, weight='bold')
    for height, line in zip((0.945, 0.928), lines):
        _text(figure, 0.05, height, line, 8)


def _size(value: float, dimension: int) -> str:
    if dimension == 2 and value >= 1e3:
        return f'{number(1e-4 * value)} ha'
    unit = 'm²' if dimension == 2 else 'm³'
    return f'{value:,.0f} {unit}' if value >= 100.0 else f'{value:.3g} {unit}'


def _reason(record: RunLog) -> str:
    # That all are found, only a simulation knows.
    reason = record.end_reason
    return 'stopped' if reason == 'all_found' else END_REASONS.get(reason, _plain(reason))


def _text(
    where: Figure | Axes, x: float, y: float, text: str, size: float = 7.0, **style: Any
) -> None:
    where.text(x, y, text, fontsize=size, parse_math=False, **style)


def _draw_map(axes: Axes, record: RunLog, explored: UnexploredMap, parts: Sequence[Sector]) -> None:
    view, bounds = MapView(axes, (0, 1)), explored.bounds
    draw_explored(view, explored, bounds)
    draw_ground(view, Area(record.scenario.environment), bounds)
    for part in parts:
        for ring in shapely.get_rings(shapely.get_parts(part.shape)):
            axes.plot(*shapely.get_coordinates(ring).T, ':', color=_GREY, lw=0.8, zorder=2)
        at = shapely.get_coordinates(part.shape.representative_point())[0]
        x, y = at.tolist()
        _text(axes, x, y, part.name, 11, color=_GREY, ha='center', va='center', alpha=0.7)
    for name, colour in robot_colours(record.scenario.names()).items():
        draw_path(view, record.trajectories[name], colour, record.end_time, name)
    least = _LEAST * float(np.ptp(bounds, axis=1).max())
    for target in record.found_targets:
        x, y = target.position[:2].tolist()
        if np.isfinite(target.covariance).all():
            shape = ellipse((x, y), target.covariance[:2, :2], _SIGMAS, least, ec=FOUND, zorder=7)
            axes.add_patch(shape)
        axes.plot(x, y, '+', color=FOUND, ms=5, zorder=8)
        style: dict[str, Any] = {'xytext': (4, 4), 'textcoords': 'offset points', 'zorder': 9}
        axes.annotate(
            str(target.id), (x, y), fontsize=7, weight='bold', annotation_clip=True, **style
        )
    margin = 0.03 * float(np.ptp(bounds[:2], axis=1).max())
    axes.set_xlim(bounds[0, 0] - margin, bounds[0, 1] + margin)
    axes.set_ylim(bounds[1, 0] - margin, bounds[1, 1] + margin)
    axes.set_aspect('equal', adjustable='box', anchor='C')
    axes.set_xlabel('x, east [m]', fontsize=7)
    axes.set_ylabel('y, north [m]', fontsize=7)
    axes.tick_params(labelsize=7)
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles))
    box: dict[str, Any] = {'loc': 'lower center', 'bbox_to_anchor': (0.5, 1.0), 'frameon': False}
    axes.legend(unique.values(), unique.keys(), ncols=6, fontsize=7, markerscale=0.6, **box)


def _write_table(
    axes: Axes, line: int, title: str, heads: Sequence[tuple[float, str]], rows: Sequence[Row]
) -> int:
    """Write a table from a line on, columns at shares of the width; return the next line."""
    _text(axes, 0.0, line + 0.5, title, 8.5, weight='bold', va='center')
    for index, row in enumerate([[head for _, head in heads], *rows], line + 1):
        colour = _GREY if index == line + 1 else 'black'
        for (at, _), text in zip(heads, row):
            _text(axes, at, index + 0.5, text, color=colour, va='center')
    return line + len(rows) + 2


Row = Sequence[str]


def _write_found(axes: Axes, record: RunLog) -> None:
    found = record.found_targets
    origin = record.scenario.environment.origin
    heads = [(0.0, 'no.'), (0.06, 'time'), (0.2, 'robot')]
    if origin is None:
        names = 'x, y [m]' if record.scenario.dimension == 2 else 'x, y, z [m]'
        heads += [(0.4, names), (0.68, '± [m]'), (0.77, 'class')]
    else:
        heads += [(0.36, 'latitude, longitude'), (0.68, '± [m]'), (0.77, 'class')]
    rows = [_found_row(record, target) for target in found[:_MOST_FOUND]]
    line = _write_table(axes, 0, f'Found targets ({len(found)})', heads, rows)
    notes = ['±: one standard deviation, in the worst direction.']
    if left := len(found) - len(rows):
        notes.insert(0, f'{left} more: see found_targets.csv')
    for index, note in enumerate(notes):
        _text(axes, 0.0, line + index + 0.5, note, 6.5, color=_GREY, va='center')


def _found_row(record: RunLog, target: FoundTarget) -> Row:
    origin, covariance = record.scenario.environment.origin, np.asarray(target.covariance)
    usable = bool(np.isfinite(covariance).all())
    spread = float(np.linalg.eigvalsh(covariance)[-1]) if usable else 0.0
    if origin is None:
        where = ', '.join(f'{value:.2f}' for value in target.position)
    else:
        latitude, longitude, _ = geodetic(target.position[None], origin)[0]
        where = f'{latitude:.6f}, {longitude:.6f}'
    label = ' '.join(filter(None, (target.label.class_id, target.label.identity)))
    return [
        str(target.id),
        _clock(record, target.time),
        _plain(target.robot, 14),
        where,
        f'{max(spread, 0.0) ** 0.5:.2f}' if usable else '-',
        _plain(label, 18),
    ]


def _write_sectors(axes: Axes, parts: Sequence[Sector]) -> int:
    heads = [(0.0, 'sector'), (0.25, 'POA'), (0.5, 'POD'), (0.75, 'POS')]
    rows = [
        [part.name, *(f'{100.0 * value:.1f} %' for value in (part.poa, part.pod, part.pos))]
        for part in parts
    ]
    total = [sum(part.poa for part in parts), sum(part.pos for part in parts)]
    pod = total[1] / total[0] if total[0] > 0.0 else 0.0
    rows.append(['all', *(f'{100.0 * value:.1f} %' for value in (total[0], pod, total[1]))])
    line = _write_table(axes, 0, 'Cumulative probabilities by sector', heads, rows)
    note = 'POA: of area, with sightings; POD: of detection; POS: of success'
    _text(axes, 0.0, line + 0.5, note, 6.5, color=_GREY, va='center')
    return line + 1


def _write_robots(axes: Axes, record: RunLog, line: int) -> None:
    names = record.scenario.names()
    heads = [(0.0, 'robot'), (0.34, 'battery'), (0.52, 'lowest'), (0.68, 'path'), (0.86, 'looks')]
    rows = []
    for name in names[:_MOST_ROBOTS]:
        charges = record.charges(name)
        ends = (
            [f'{100.0 * value:.0f} %' for value in (charges[-1], min(charges))] if charges else []
        )
        looks = str(record.measurements[name])
        length = f'{record.distance[name]:,.0f} m'
        rows.append([_plain(name, 16), *(ends or ['unknown', '-']), length, looks])
    if left := len(names) - len(rows):
        rows.append([f'{left} more: see report.json'])
    _write_table(axes, line, 'Robots and batteries at the end', heads, rows)

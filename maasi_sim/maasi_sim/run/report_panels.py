"""Parts of the figures of reports: views from above and the side, paths over time, legend."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec, SubplotSpec
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_sim.run.report_files import title
from maasi_sim.run.run_record import RunRecord

# Palette for colour-blind readers (Okabe and Ito).
COLOURS = ('#0072B2', '#E69F00', '#009E73', '#CC79A7', '#56B4E9', '#8C564B')
PALE, GRID, UNSEEN = '#9A9A9A', '#E6E6E6', '#CFCFCF'
# Of axes to the right of the last value, or a step at the end cannot be seen.
MARGIN = 1.015
_NAMES = 'xyz'
# A side view is at least this share of the size of the view from above.
_THINNEST = 0.22
_CORNER = 0.6
# Sizes of a legend [inch]: beside a text, of a letter, of a row; and what the corner holds.
_HANDLE, _LETTER, _ROW = 0.75, 0.068, 0.2
_CORNER_WIDTH, _CORNER_ROWS = 3.2, 15


@dataclass(frozen=True)
class MapView:
    """Axes that show two of the map's axes: those to the right and upwards, 0, 1, 2 for x, y, z."""

    axes: Axes
    plane: tuple[int, int]

    def points(self, places: ArrayLike, width: int = 3) -> FloatArray:
        """Return places (n, d) [m, map] in this view, (2, n)."""
        array = np.asarray(places, dtype=float).reshape(-1, width)
        return array[:, list(self.plane)].T


@dataclass
class Panels:
    """The axes of a figure.

    Views are the map in 2D; in 3D from above, from the south, and from the east. Plots are beside
    them, from top to bottom. The second row of the grid, of no height yet, is for a legend, and so
    is the corner between the views, if there is room.
    """

    figure: Figure
    views: list[MapView]
    plots: list[Axes]
    grid: GridSpec
    corner: SubplotSpec | None


def make_panels(area: FloatArray, robots: int, heights: Sequence[float]) -> Panels:
    """Return the axes of a new figure.

    The views show an area, (d, 2) [m, map]; the second plot has a band for each robot, and those
    after it have relative heights.
    """
    figure = Figure(figsize=(13.0, 8.0), layout='constrained')
    FigureCanvasAgg(figure)
    heights = [1.0, 0.12 + 0.1 * min(robots, 8), *heights]
    size = area[:, 1] - area[:, 0]
    outer = GridSpec(2, 2, figure, width_ratios=[1.5, 1.0], height_ratios=[1.0, 1e-6])
    views = []
    corner = None
    if len(area) == 2:
        views.append(MapView(figure.add_subplot(outer[0, 0]), (0, 1)))
    else:
        deep = max(float(size[2]), _THINNEST * float(size[:2].max()))
        inner = outer[0, 0].subgridspec(
            2, 2, width_ratios=[size[0], deep], height_ratios=[size[1], deep]
        )
        above = figure.add_subplot(inner[0, 0])
        views = [
            MapView(above, (0, 1)),
            MapView(figure.add_subplot(inner[1, 0], sharex=above), (0, 2)),
            MapView(figure.add_subplot(inner[0, 1], sharey=above), (2, 1)),
        ]
        # Unless the side views are thin.
        corner = inner[1, 1] if deep > _CORNER * float(size[:2].max()) else None
    for view in views:
        right, up = view.plane
        margin = 0.035 * float(size.max())
        view.axes.set_xlim(area[right, 0] - margin, area[right, 1] + margin)
        view.axes.set_ylim(area[up, 0] - margin, area[up, 1] + margin)
        view.axes.set_aspect('equal', adjustable='box', anchor='NW')
        view.axes.set_xlabel(f'{_NAMES[right]} [m]')
        view.axes.set_ylabel(f'{_NAMES[up]} [m]')
        view.axes.spines[['top', 'right']].set_visible(False)
    beside = outer[0, 1].subgridspec(len(heights), 1, height_ratios=heights)
    plots = [figure.add_subplot(beside[row]) for row in range(len(heights))]
    return Panels(figure, views, plots, outer, corner)


def finish_figure(
    panels: Panels,
    record: RunRecord,
    colours: Mapping[str, str],
    heading: str,
    rows: Sequence[tuple[str, str]],
) -> Figure:
    """Draw the bands of the robots, the last rows of text and the titles; return the figure.

    The first plot, over time, has the heading; the last one takes the rows.
    """
    over, times = panels.plots[:2]
    over.sharex(times)
    over.tick_params(labelbottom=False)
    over.set_title(heading, fontsize=11, loc='left')
    _draw_times(times, colours, record.end_time)
    times.set_xlim(0.0, MARGIN * max(record.end_time, 1e-9))
    _write_rows(panels.plots[-1], rows)
    panels.figure.suptitle(title(record), fontsize=13, fontweight='bold')
    return panels.figure


def event_rows(record: RunRecord, most: int, digits: int) -> list[tuple[str, str]]:
    """Return the first events as rows of text, with time [s]."""
    return [
        (
            f'{event["time"]:.{digits}f} s',
            f'{event.get("agent", event.get("node", ""))} {event["event"]}',
        )
        for event in record.events[:most]
    ]


def fade(colour: str) -> LinearSegmentedColormap:
    """Return the shades of a robot's colour, from light at the beginning to dark at the end."""
    middle = np.array(to_rgb(colour))
    return LinearSegmentedColormap.from_list(
        colour, [0.4 * middle + 0.6, middle, 0.6 * middle], N=64
    )


def draw_way(view: MapView, path: FloatArray, colour: str, end: float, label: str) -> None:
    """Draw a way of rows time [s], x, y, z [m], darker with time up to `end` [s]."""
    if len(path):
        places = view.points(path[:, 1:]).T
        lines = LineCollection(
            np.stack([places[:-1], places[1:]], axis=1),  # type: ignore[arg-type]
            cmap=fade(colour),
            linewidths=1.6,
            capstyle='round',
            zorder=3,
        )
        lines.set_array(path[:-1, 0])
        lines.set_clim(0.0, max(end, 1e-9))
        view.axes.add_collection(lines)
        for place, marker in ((places[0], 's'), (places[-1], 'o')):
            view.axes.plot(*place, marker, color=colour, ms=8, mec='white', zorder=6)
    view.axes.plot([], [], '-', color=colour, lw=2.0, label=label)


def draw_start_and_end(view: MapView) -> None:
    """Add start and end of ways to the legend."""
    view.axes.plot([], [], 's', color=PALE, ms=7, label='start')
    view.axes.plot([], [], 'o', color=PALE, ms=7, label='end')


def _draw_times(axes: Axes, colours: Mapping[str, str], end: float) -> None:
    """Draw a band for each robot: which shade of its way is which time [s]."""
    for row, (_, colour) in enumerate(colours.items()):
        axes.imshow(
            np.linspace(0.0, 1.0, 256)[None, :],
            cmap=fade(colour),
            aspect='auto',
            extent=(0.0, max(end, 1e-9), row + 0.4, row - 0.4),
        )
    axes.set_ylim(len(colours) - 0.5, -0.5)
    axes.set_yticks(range(len(colours)), list(colours), fontsize=8)
    axes.tick_params(axis='y', length=0)
    axes.set_xlabel('time [s], and the shades of the ways')
    axes.spines[['top', 'right', 'left']].set_visible(False)


def add_legend(panels: Panels) -> None:
    """Add a legend of all views with each label once, in axes that are large enough."""
    figure = panels.figure
    unique: dict[str, Any] = {}
    for view in panels.views:
        handles, labels = view.axes.get_legend_handles_labels()
        unique |= dict(zip(labels, handles))
    width, height = figure.get_size_inches()
    widest = _HANDLE + _LETTER * max(map(len, unique))
    if panels.corner is not None and widest < _CORNER_WIDTH and len(unique) <= _CORNER_ROWS:
        place, columns = panels.corner, 1
    else:
        columns = max(1, int(0.95 * width / widest))
        share = (_ROW * -(-len(unique) // columns) + 0.1) / height
        panels.grid.set_height_ratios([1.0 - share, share])
        place = panels.grid[1, :]
    axes = figure.add_subplot(place)
    axes.set_axis_off()
    legend = axes.legend(
        list(unique.values()),
        list(unique),
        loc='center',
        ncol=columns,
        fontsize=8.5,
        markerscale=0.7,
        labelspacing=0.6,
        frameon=False,
    )
    # The axes already reserve its space in the layout.
    legend.set_in_layout(False)


def _write_rows(axes: Axes, rows: Sequence[tuple[str, str]], least: int = 10) -> None:
    """Write names and values below each other, with space for at least `least`."""
    axes.set_axis_off()
    for index, (key, value) in enumerate(rows):
        height = 1.0 - (index + 0.5) / max(len(rows), least)
        axes.text(0.0, height, key, color='#666666', fontsize=9.5, va='center')
        axes.text(0.3, height, value, fontsize=9.5, va='center')


def step_plot(axes: Axes, label: str, draw: Callable[[Axes], None]) -> None:
    """Draw a plot of counts with whole numbers upwards."""
    draw(axes)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(label)
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[['top', 'right']].set_visible(False)

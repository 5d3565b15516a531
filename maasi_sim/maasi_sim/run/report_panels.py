"""The layout of report figures: the map from above and the sides, paths, plots and text."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec, SubplotSpec
from matplotlib.patches import Circle, Ellipse, Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.colours import KEEP_OUT
from maasi_filter.geometry.area import Area
from maasi_sim.run.log import RunRecord

PALE, GRID, UNSEEN = '#9A9A9A', '#E6E6E6', '#CFCFCF'
MARGIN = 1.015  # space to the right of the last value
# Size [inch], the share of the legend next to a text, and per letter.
_SIZE, _HANDLE, _LETTER = (13.0, 8.0), 0.75, 0.068
_THINNEST = 0.22  # smallest relative size of a side view


@dataclass(frozen=True)
class MapView:
    """Axes that show two axes of the map, to the right and upwards (0, 1, 2: x, y, z)."""

    axes: Axes
    plane: tuple[int, int]

    def points(self, places: ArrayLike, width: int = 3) -> FloatArray:
        """Return positions (n, d) [m, map] in this view, (2, n)."""
        array = np.asarray(places, dtype=float).reshape(-1, width)
        return array[:, list(self.plane)].T


def ellipse(
    place: tuple[float, float], covariance: FloatArray, sigmas: float, least: float, **style: Any
) -> Ellipse:
    """Return the ellipse of some deviations at a position [m], at least of a given size."""
    values, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    widths = 2.0 * np.maximum(sigmas * np.sqrt(np.maximum(values, 0.0)), least)
    angle = math.degrees(math.atan2(directions[1, 0], directions[0, 0]))
    return Ellipse(place, *widths, angle=angle, fill=False, **style)


def draw_ground(view: MapView, area: Area, bounds: FloatArray) -> None:
    """Draw zones and obstacles of an area with bounds (d, 2) [m]."""
    style: dict[str, Any] = {'fc': '#C9C3B8', 'ec': '#8A8478', 'zorder': 1, 'label': 'obstacle'}
    for kind, shapes in area.shapes.items() if view.plane == (0, 1) else ():
        for ring in shapely.get_rings(shapely.get_parts(shapes)):
            colour = {'area': '#1B1F24', 'keep_out': KEEP_OUT, 'obstacle': '#8A8478'}[kind]
            label = kind.replace('_', '-')
            view.axes.plot(*shapely.get_coordinates(ring).T, color=colour, lw=1.2, label=label)
    for *centre, radius, is_sphere in area.solid.tolist():
        centre = centre if is_sphere else centre[:2]
        if max(view.plane) < len(centre):
            place = (centre[view.plane[0]], centre[view.plane[1]])
            view.axes.add_patch(Circle(place, radius, **style))
            continue
        # An upright cylinder from the side.
        low, high = bounds[2]
        if view.plane[0] == 2:
            corner, size = (low, centre[1] - radius), (high - low, 2.0 * radius)
        else:
            corner, size = (centre[0] - radius, low), (2.0 * radius, high - low)
        view.axes.add_patch(Rectangle(corner, *size, **style))


# A plot next to the map: label of its right axis, relative height, drawing function.
Plot = tuple[str, float, Callable[[Axes], None]]


def draw_report(
    record: RunRecord,
    colours: Mapping[str, str],
    area: FloatArray,
    draw_map: Callable[[MapView], None],
    plots: Sequence[Plot],
    heading: str,
    rows: Sequence[tuple[str, str]],
) -> Figure:
    """Return the figure of a report: map with paths, plots over time, and rows of text."""
    figure = Figure(figsize=_SIZE, layout='constrained')
    FigureCanvasAgg(figure)
    halves = GridSpec(1, 2, figure, width_ratios=[1.5, 1.0])
    views = _map_views(figure, halves[0], area)
    for view in views:
        draw_map(view)
        for name, colour in colours.items():
            draw_path(view, record.trajectories[name], colour, record.end_time, name)
    for marker, label in (('s', 'start'), ('o', 'end')):
        views[0].axes.plot([], [], marker, color=PALE, ms=7, label=label)
    _add_legend(figure, views)
    first, *further = (height for _, height, _ in plots)
    heights = [first, 0.12 + 0.1 * min(len(colours), 8), *further, 1.5]
    grid = halves[1].subgridspec(len(heights), 1, height_ratios=heights)
    over, times, *others, text = (figure.add_subplot(grid[row]) for row in range(len(heights)))
    for axes, (label, _, draw) in zip([over, *others], plots):
        draw(axes)
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_xlabel(label)
        axes.grid(color=GRID, lw=0.8)
        axes.set_axisbelow(True)
        axes.spines[['top', 'right']].set_visible(False)
    over.sharex(times)
    over.tick_params(labelbottom=False)
    over.set_title(heading, fontsize=11, loc='left')
    _draw_times(times, colours, max(record.end_time, 1e-9))
    words = [
        (f'{event["time"]:.1f} s', f'{event.get("agent", event.get("node", ""))} {event["event"]}')
        for event in record.events[:3]
    ]
    _write_rows(text, [*rows, *words])
    planner = record.scenario.planner.name
    title = f'{record.name}   seed {record.seed}   planner {planner}'
    figure.suptitle(title, fontsize=13, fontweight='bold', parse_math=False)
    return figure


def _map_views(figure: Figure, place: SubplotSpec, area: FloatArray) -> list[MapView]:
    size = area[:, 1] - area[:, 0]
    if len(area) == 2:
        views = [MapView(figure.add_subplot(place), (0, 1))]
    else:
        deep = max(float(size[2]), _THINNEST * float(size[:2].max()))
        inner = place.subgridspec(2, 2, width_ratios=[size[0], deep], height_ratios=[size[1], deep])
        above = figure.add_subplot(inner[0, 0])
        views = [
            MapView(above, (0, 1)),
            MapView(figure.add_subplot(inner[1, 0], sharex=above), (0, 2)),
            MapView(figure.add_subplot(inner[0, 1], sharey=above), (2, 1)),
        ]
    margin = 0.035 * float(size.max())
    for view in views:
        right, up = view.plane
        view.axes.set_xlim(area[right, 0] - margin, area[right, 1] + margin)
        view.axes.set_ylim(area[up, 0] - margin, area[up, 1] + margin)
        view.axes.set_aspect('equal', adjustable='box', anchor='NW')
        view.axes.set_xlabel(f'{"xyz"[right]} [m]')
        view.axes.set_ylabel(f'{"xyz"[up]} [m]')
        view.axes.spines[['top', 'right']].set_visible(False)
    return views


def _shades(colour: str) -> LinearSegmentedColormap:
    middle = np.array(to_rgb(colour))
    return LinearSegmentedColormap.from_list(
        colour, [0.4 * middle + 0.6, middle, 0.6 * middle], N=64
    )


def draw_path(view: MapView, path: FloatArray, colour: str, end: float, label: str) -> None:
    """Draw the states (n, 4) of a robot, shaded by time until the end [s]."""
    if len(path):
        places = view.points(path[:, 1:]).T
        lines = LineCollection(
            np.stack([places[:-1], places[1:]], axis=1),  # type: ignore[arg-type]
            cmap=_shades(colour),
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


def _draw_times(axes: Axes, colours: Mapping[str, str], end: float) -> None:
    for row, colour in enumerate(colours.values()):
        axes.imshow(
            np.linspace(0.0, 1.0, 256)[None, :],
            cmap=_shades(colour),
            aspect='auto',
            extent=(0.0, end, row + 0.4, row - 0.4),
        )
    axes.set_xlim(0.0, MARGIN * end)
    axes.set_ylim(len(colours) - 0.5, -0.5)
    axes.set_yticks(range(len(colours)), list(colours), fontsize=8)
    axes.tick_params(axis='y', length=0)
    axes.set_xlabel('time [s] and the shades of the paths')
    axes.spines[['top', 'right', 'left']].set_visible(False)


def _add_legend(figure: Figure, views: Sequence[MapView]) -> None:
    unique: dict[str, Any] = {}
    for view in views:
        handles, labels = view.axes.get_legend_handles_labels()
        unique |= dict(zip(labels, handles))
    widest = _HANDLE + _LETTER * max(map(len, unique))
    figure.legend(
        list(unique.values()),
        list(unique),
        loc='outside lower center',
        ncols=max(1, int(0.95 * _SIZE[0] / widest)),
        fontsize=8.5,
        markerscale=0.7,
        labelspacing=0.6,
        frameon=False,
    )


def _write_rows(axes: Axes, rows: Sequence[tuple[str, str]]) -> None:
    axes.set_axis_off()
    for index, (key, value) in enumerate(rows):
        height = 1.0 - (index + 0.5) / max(len(rows), 10)
        axes.text(0.0, height, key, color='#666666', fontsize=9.5, va='center')
        axes.text(0.3, height, value, fontsize=9.5, va='center')

"""Figures in the form of the papers', and that of a comparison of searches."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from operator import getitem
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_sim.experiments.experiment import Results, Run
from maasi_sim.experiments.statistics import mean_interval
from maasi_sim.experiments.tables import COMPLETE, TIME, SearchTable, interval, shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Colour and line of each method, those of 000, figure 4.
STYLES: dict[str, tuple[str, str]] = {
    'lawnmower': ('#1F4FD8', '-'),
    'mutual': ('#D62728', '--'),
    'sung': ('#FF9F1C', ':'),
    'as': ('#17BECF', '-.'),
    'asi': ('#2CA02C', ':'),
    'event': ('#0B5D1E', '-'),
    'recommended': ('#7B3294', '-'),
}
# For colour-blind readers (Okabe and Ito).
_OTHERS = ('#0072B2', '#E69F00', '#009E73', '#CC79A7', '#56B4E9', '#8C564B')
_COMPARED = ('#0072B2', '#E69F00', '#009E73', '#CC79A7', '#56B4E9', '#D55E00', '#8C564B')
_LINES = ('-', '--', '-.', ':')
_FEWEST_SHADED = 4
_TRUE, _FOUND, _PALE = '#222222', '#D62728', '#9A9A9A'


def as_png(draw: Callable[[Figure], None], dpi: int = 110) -> bytes:
    """Return a figure, drawn by a function, as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 5.0), layout='constrained')
    FigureCanvasAgg(figure)
    draw(figure)
    stream = io.BytesIO()
    figure.savefig(stream, dpi=dpi, format='png')
    return stream.getvalue()


def _found_over(run: Run, grid: FloatArray, by: str) -> FloatArray:
    if not len(run.columns[by]):
        return np.zeros(len(grid))
    index = np.searchsorted(run.columns[by], grid, side='right') - 1
    return np.where(index >= 0, run.columns['true_found'][np.maximum(index, 0)], 0.0)


def draw_curves(
    figure: Figure,
    results: Results,
    styles: Mapping[str, str],
    path: str | None = None,
    by: str = 'measurements',
    label: str = 'measurements',
    end: float | None = None,
) -> None:
    """Draw the mean number of targets found, of four or more runs with its 95 % confidence.

    `styles` has a key of `STYLES` by case; the first run of the case `path` is drawn next to the
    curves. Over measurements, triangles mark where the paper's methods have found all.
    """
    if path is not None:
        figure.set_size_inches(10.5, 4.6)
    axes = figure.add_subplot(1, 1 if path is None else 2, 1)
    targets = 0.0
    shown_runs = [run for name in styles for run in results.runs.get(name, [])]
    ends = [float(run.columns[by][-1]) for run in shown_runs if len(run.columns[by])]
    grid = np.linspace(0.0, end or max(ends, default=1.0), 400)
    for index, (name, key) in enumerate(styles.items()):
        runs = results.runs.get(name, [])
        if not runs:
            continue
        colour, line = STYLES.get(key, (_OTHERS[index % len(_OTHERS)], '-'))
        values = np.array([_found_over(run, grid, by) for run in runs])
        spans = [mean_interval(column) for column in values.T]
        mean = np.array([span.mean for span in spans])
        half = np.nan_to_num(np.array([span.half_width for span in spans]))
        axes.plot(grid, mean, line, color=colour, lw=1.8, label=name)
        # With two or three runs the confidence band would fill the figure.
        if len(runs) >= _FEWEST_SHADED:
            axes.fill_between(grid, mean - half, mean + half, color=colour, alpha=0.15, lw=0)
        targets = max(targets, *(run.value('targets') or 0.0 for run in runs))
    axes.axhline(targets, color=_TRUE, lw=0.8, ls='--')
    axes.set(xlim=(0.0, grid[-1]), ylim=(0.0, 1.06 * max(targets, 1.0)))
    axes.set(xlabel=label, ylabel='targets found')
    _frame(axes)
    axes.set_axisbelow(True)
    if by == 'measurements':
        _mark_published(axes, results, styles)
    axes.legend(loc='lower right', fontsize=8, frameon=False)
    runs = [] if path is None else results.runs.get(path, [])
    if runs:
        _draw_path(figure, (1, 2, 2), results, runs[0])


def _frame(axes: Axes) -> None:
    axes.grid(color='#E6E6E6', lw=0.8)
    axes.spines[['top', 'right']].set_visible(False)


def _mark_published(axes: Axes, results: Results, styles: Mapping[str, str]) -> None:
    label: str | None = "all found, the paper's"
    published = results.experiment.published_of('measurements_to_find_all')
    for name, key in styles.items():
        if name in published:
            axes.errorbar(
                published[name].value,
                axes.get_ylim()[1] * 0.985,
                xerr=published[name].half_width,
                fmt='v',
                color=STYLES.get(key, (_PALE, '-'))[0],
                mec=_TRUE,
                ms=7,
                capsize=3,
                label=label,
            )
            label = None


def _draw_path(figure: Figure, place: tuple[int, int, int], results: Results, run: Run) -> None:
    # Deferred: Matplotlib takes long to import.
    from maasi_sim.run.report_panels import MapView, draw_ground

    scenario = results.case(run.case).settings['scenario']
    bounds = np.array(scenario['environment']['bounds'], dtype=float)
    dimension = len(bounds)
    axes: Any = figure.add_subplot(*place, projection='3d' if dimension == 3 else None)
    if 'heights' in run.details:
        heights = np.array(run.details['heights'], float)
        sides = [
            np.linspace(bounds[axis, 0], bounds[axis, 1], heights.shape[axis]) for axis in (0, 1)
        ]
        axes.contourf(*sides, heights.T, levels=12, cmap='gist_earth', alpha=0.5)
    for index, (name, robot) in enumerate(scenario['robots'].items()):
        colour = _OTHERS[index % len(_OTHERS)]
        places = np.column_stack([run.columns[f'{name}_{axis}'] for axis in 'xyz'])
        places = np.vstack([np.asarray(robot['start'], float), places])[:, :dimension]
        axes.plot(*places.T, '-', color=colour, lw=1.0, label=name)
        measured = run.columns[f'{name}_measures'] > 0.0
        axes.plot(*places[1:][measured].T, '.', color=colour, ms=2.5)
    area = Area(EnvironmentSettings.model_validate(scenario['environment']))
    if dimension == 2:
        draw_ground(MapView(axes, (0, 1)), area, bounds)
    for *centre, radius, is_sphere in area.solid:
        if dimension == 3 and is_sphere:
            _sphere(axes, np.array(centre), radius)
    truth = np.array(run.details['truth'], float).reshape(-1, dimension)
    found = np.array(run.details['found'], float).reshape(-1, dimension)
    axes.plot(*truth.T, 'D', mfc='none', mec=_TRUE, ms=6, label='true target')
    axes.plot(*found.T, 'D', color=_FOUND, ms=3.5, label='found target')
    axes.set(xlim=bounds[0], ylim=bounds[1])
    axes.set_xlabel('x [m]', fontsize=7)
    axes.set_ylabel('y [m]', fontsize=7)
    axes.tick_params(labelsize=6)
    if dimension == 3:
        axes.set_zlim(*bounds[2])
    else:
        axes.set_aspect('equal')
    axes.set_title(run.case, fontsize=9)


def _sphere(axes: Any, centre: FloatArray, radius: float) -> None:
    around = np.linspace(0.0, 2.0 * np.pi, 17)[:, None]
    down = np.linspace(0.0, np.pi, 9)[None, :]
    axes.plot_surface(
        centre[0] + radius * np.cos(around) * np.sin(down),
        centre[1] + radius * np.sin(around) * np.sin(down),
        centre[2] + radius * np.cos(down) + 0.0 * around,
        color='#C9C3B8',
        alpha=0.5,
        linewidth=0,
    )


def draw_paths(figure: Figure, results: Results, cases: Sequence[str] | None = None) -> None:
    """Draw the paths of several cases, or all, on the first map, side by side."""
    shown_cases = [case.name for case in results.cases] if cases is None else cases
    listed = [run for name in shown_cases for run in results.runs.get(name, []) if run.number == 0]
    columns = min(3, max(len(listed), 1))
    rows = -(-max(len(listed), 1) // columns)
    figure.set_size_inches(3.4 * columns, 3.3 * rows)
    for index, run in enumerate(listed):
        _draw_path(figure, (rows, columns, index + 1), results, run)


def draw_against(
    figure: Figure, results: Results, setting: Sequence[str], label: str, quantities: Sequence[str]
) -> None:
    """Draw means, with 95 % confidence, against the number of the scenario at keys `setting`."""
    figure.set_size_inches(4.6 * len(quantities), 3.8)
    for index, quantity in enumerate(map(results.experiment.quantity, quantities)):
        axes = figure.add_subplot(1, len(quantities), index + 1)
        scenarios = [results.case(name).settings['scenario'] for name in results.names()]
        places = [reduce(getitem, setting, scenario) for scenario in scenarios]
        spans = [interval(results, name, quantity) for name in results.names()]
        means = [span.mean for span in spans]
        halves = np.nan_to_num([span.half_width for span in spans])
        axes.errorbar(places, means, yerr=halves, fmt='o-', color=_OTHERS[index], ms=4, capsize=2)
        axes.set(xlabel=label, ylabel=quantity.title())
        _frame(axes)


def draw_table(
    figure: Figure, results: Results, axes: Sequence[Sequence[str]], quantity: str
) -> None:
    """Draw a table of means above the papers' as they print it; joined heads name the cases."""
    measured = results.experiment.quantity(quantity)
    rows = axes[0]
    columns = axes[1] if len(axes) > 1 else [textwrap.fill(measured.label, 20)]
    figure.set_size_inches(1.3 + 1.45 * len(columns), 0.8 + 0.62 * len(rows))
    plot = figure.add_subplot()
    plot.axis('off')
    published = results.experiment.published_of(quantity)
    cells, means = [], np.full((len(rows), len(columns)), np.nan)
    for i, row in enumerate(rows):
        line = []
        for j, column in enumerate(columns):
            name = f'{row}, {column}' if len(axes) > 1 else row
            if not results.runs.get(name):
                line.append('-')
                continue
            ours = interval(results, name, measured)
            means[i, j] = ours.mean
            text = shown(ours)
            if name in published:
                item = published[name]
                spread = '' if item.half_width is None else f' ± {item.half_width:g}'
                text += f'\npaper {item.value:g}{spread}'
            line.append(text)
        cells.append(line)
    table = plot.table(
        cells,
        rowLabels=list(rows),
        colLabels=list(columns),
        cellLoc='center',
        loc='center',
        bbox=[0.0, 0.0, 1.0, 1.0],  # type: ignore[arg-type]
    )
    table.auto_set_font_size(False)
    table.set_fontsize(8)
    low, high = np.nanmin(means, initial=np.inf), np.nanmax(means, initial=-np.inf)
    for (i, j), cell in table.get_celld().items():
        if i > 0 and j >= 0 and np.isfinite(means[i - 1, j]) and high > low:
            share = (means[i - 1, j] - low) / (high - low)
            cell.set_facecolor((1.0, 1.0 - 0.45 * share, 1.0 - 0.55 * share))


def draw_comparison(figure: Figure, tables: Sequence[SearchTable]) -> None:
    """Draw a row for each scenario: survival curves, and paired differences to the first case."""
    most = max(len(table.cases) for table in tables)
    figure.set_size_inches(11.0, max(3.6, 1.6 + 0.4 * most) * len(tables))
    axes = figure.subplots(len(tables), 2, squeeze=False)
    for table, (left, right) in zip(tables, axes):
        _draw_survival(left, table.results)
        _draw_differences(right, table)


def _draw_survival(axes: Axes, results: Results) -> None:
    end = 0.0
    for index, name in enumerate(results.names()):
        durations = results.values(name, TIME.name)
        missing = results.values(name, COMPLETE.name) == 0.0
        curve = stats.ecdf(stats.CensoredData.right_censored(durations, missing)).sf
        shares = [100.0, *(100.0 * curve.probabilities)]
        last = float(durations.max())
        end = max(end, last)
        line = _LINES[index // len(_COMPARED) % len(_LINES)]
        colour = _COMPARED[index % len(_COMPARED)]
        axes.step(
            [0.0, *curve.quantiles, last],
            [*shares, shares[-1]],
            line,
            where='post',
            color=colour,
            lw=1.8,
            label=name,
        )
    axes.set(xlim=(0.0, 1.02 * end or 1.0), ylim=(0.0, 103.0))
    axes.set(xlabel='time [s]', ylabel='searches that still miss targets [%]')
    axes.set_title(results.experiment.name, loc='left', fontsize=10, fontweight='bold')
    _frame(axes)
    axes.legend(fontsize=8, frameon=False)


def _draw_differences(axes: Axes, table: SearchTable) -> None:
    names = table.cases
    axes.axvline(0.0, color='#222222', lw=0.8)
    for row, name in enumerate(names[1:]):
        colour = _COMPARED[(row + 1) % len(_COMPARED)]
        gaps = np.subtract(*table.results.pairs(name, names[0], TIME.name))
        # Spread, by the same seed, so that equal values can be seen.
        lift = np.random.default_rng(0).uniform(0.12, 0.3, len(gaps))
        axes.plot(gaps, row + lift, 'o', color=colour, ms=4, alpha=0.45, mew=0)
        mean = table.differences[name][TIME.name]
        axes.plot([mean.low, mean.high], [row, row], '-', color=colour, lw=3, solid_capstyle='butt')
        axes.plot([mean.mean], [row], 'D', color=colour, ms=7, mec='white')
    axes.set_yticks(range(len(names) - 1), names[1:])
    axes.set_ylim(len(names) - 1.5, -0.5)
    axes.set_xlabel(f'time to find all, minus {names[0] if names else ""} [s]')
    axes.set_title('Each seed, mean and 95 % interval', loc='left', fontsize=10)
    axes.grid(axis='x', color='#E6E6E6', lw=0.8)
    axes.spines[['top', 'right', 'left']].set_visible(False)

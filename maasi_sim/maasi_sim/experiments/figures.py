"""Draws what can be laid beside the papers' figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from maasi_sim.experiments.cases import Quantity
from maasi_sim.experiments.experiment import Results
from maasi_sim.experiments.results import Run
from maasi_sim.experiments.statistics import mean_interval
from maasi_sim.experiments.tables import interval, shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]

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
_OTHERS = ('#0072B2', '#E69F00', '#009E73', '#CC79A7', '#56B4E9', '#8C564B')
_FEWEST_SHADED = 4
_TRUE, _FOUND, _PALE = '#222222', '#D62728', '#9A9A9A'


def over(run: Run, grid: FloatArray, column: str = 'true_found', by: str = 'measurements') -> Any:
    """Return a column of a run as a function of another: the last value at or before each point.

    Parameters
    ----------
    run : Run
        With both columns.
    grid : (n,) array
        Where.
    column, by : str
        Names; `by` must not fall.
    """
    places = run.columns[by]
    if not len(places):
        return np.zeros(len(grid))
    index = np.searchsorted(places, grid, side='right') - 1
    return np.where(index >= 0, run.columns[column][np.maximum(index, 0)], 0.0)


def curves(
    axes: Axes,
    results: Results,
    styles: Mapping[str, str],
    by: str = 'measurements',
    label: str = 'measurements',
    end: float | None = None,
) -> None:
    """Draw the mean number of targets found, of four or more runs with its 95 % confidence.

    Parameters
    ----------
    axes : Axes
        Where.
    results : Results
        Of searches.
    styles : mapping
        Which cases, and the key in `STYLES` of each; an unknown key takes another colour.
    by, label : str
        Column of the horizontal axis and its name.
    end : float, optional
        Of the horizontal axis; none: the longest run.
    """
    targets = 0.0
    longest = max(
        (
            float(run.columns[by][-1])
            for name in styles
            for run in results.runs.get(name, [])
            if len(run.columns[by])
        ),
        default=1.0,
    )
    grid = np.linspace(0.0, end or longest, 400)
    for index, (name, key) in enumerate(styles.items()):
        runs = results.runs.get(name, [])
        if not runs:
            continue
        colour, line = STYLES.get(key, (_OTHERS[index % len(_OTHERS)], '-'))
        values = np.array([over(run, grid, by=by) for run in runs])
        spans = [mean_interval(column) for column in values.T]
        mean = np.array([span.mean for span in spans])
        half = np.nan_to_num(np.array([span.half_width for span in spans]))
        axes.plot(grid, mean, line, color=colour, lw=1.8, label=name)
        # Of two or three runs it would fill the picture.
        if len(runs) >= _FEWEST_SHADED:
            axes.fill_between(grid, mean - half, mean + half, color=colour, alpha=0.15, lw=0)
        targets = max(targets, *(run.value('targets') or 0.0 for run in runs))
    axes.axhline(targets, color=_TRUE, lw=0.8, ls='--')
    axes.set_xlim(0.0, grid[-1])
    axes.set_ylim(0.0, 1.06 * max(targets, 1.0))
    axes.set_xlabel(label)
    axes.set_ylabel('targets found')
    axes.grid(color='#E6E6E6', lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[['top', 'right']].set_visible(False)
    axes.legend(loc='lower right', fontsize=8, frameon=False)


def published_marks(axes: Axes, results: Results, styles: Mapping[str, str]) -> None:
    """Mark on the top line when the paper's methods have found all, with its confidence."""
    shown_label = False
    for name, key in styles.items():
        for item in results.experiment.published:
            if (item.case, item.quantity) != (name, 'measurements_to_find_all'):
                continue
            colour, _ = STYLES.get(key, (_PALE, '-'))
            axes.errorbar(
                item.value,
                axes.get_ylim()[1] * 0.985,
                xerr=item.half_width,
                fmt='v',
                color=colour,
                mec=_TRUE,
                ms=7,
                capsize=3,
                label=None if shown_label else "all found, the paper's",
            )
            shown_label = True
    if shown_label:
        axes.legend(loc='lower right', fontsize=8, frameon=False)


def path(axes: Any, results: Results, run: Run, title: str = '') -> None:
    """Draw where the robots measured, the true targets, and those found, in 2D or 3D."""
    scenario = results.case(run.case).settings['scenario']
    bounds = np.array(scenario['environment']['bounds'], dtype=float)
    dimension = len(bounds)
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
    for obstacle in scenario['environment']['obstacles']:
        _obstacle(axes, np.array(obstacle['centre'], float), float(obstacle['radius']), dimension)
    truth = np.array(run.details['truth'], float).reshape(-1, dimension)
    found = np.array(run.details['found'], float).reshape(-1, dimension)
    axes.plot(*truth.T, 'D', mfc='none', mec=_TRUE, ms=6, label='true target')
    axes.plot(*found.T, 'D', color=_FOUND, ms=3.5, label='found target')
    axes.set_xlim(*bounds[0])
    axes.set_ylim(*bounds[1])
    axes.set_xlabel('x [m]', fontsize=7)
    axes.set_ylabel('y [m]', fontsize=7)
    axes.tick_params(labelsize=6)
    if dimension == 3:
        axes.set_zlim(*bounds[2])
    else:
        axes.set_aspect('equal')
    axes.set_title(title or run.case, fontsize=9)


def _obstacle(axes: Any, centre: FloatArray, radius: float, dimension: int) -> None:
    from matplotlib.patches import Circle

    if dimension == 2:
        axes.add_patch(Circle((centre[0], centre[1]), radius, fc='#C9C3B8', ec='#8A8478'))
        return
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


def paths(figure: Figure, results: Results, cases: Sequence[str], number: int = 0) -> None:
    """Draw the paths of several cases on one map, side by side."""
    listed = [run for name in cases for run in results.runs.get(name, []) if run.number == number]
    columns = min(3, max(len(listed), 1))
    rows = -(-max(len(listed), 1) // columns)
    figure.set_size_inches(3.4 * columns, 3.3 * rows)
    for index, run in enumerate(listed):
        bounds = results.case(run.case).settings['scenario']['environment']['bounds']
        projection = '3d' if len(bounds) == 3 else None
        axes = figure.add_subplot(rows, columns, index + 1, projection=projection)
        path(axes, results, run)


def curves_and_path(
    figure: Figure, results: Results, styles: Mapping[str, str], shown_case: str, **options: Any
) -> None:
    """Draw the curves, and beside them the path of one case on the first map."""
    figure.set_size_inches(10.5, 4.6)
    axes = figure.add_subplot(1, 2, 1)
    curves(axes, results, styles, **options)
    if options.get('by', 'measurements') == 'measurements':
        published_marks(axes, results, styles)
    runs = results.runs.get(shown_case, [])
    if runs:
        bounds = results.case(shown_case).settings['scenario']['environment']['bounds']
        projection = '3d' if len(bounds) == 3 else None
        path(figure.add_subplot(1, 2, 2, projection=projection), results, runs[0])


def against(
    figure: Figure,
    results: Results,
    names: Mapping[str, float],
    label: str,
    quantities: Sequence[Quantity],
) -> None:
    """Draw means of quantities with their 95 % confidence against a number that cases differ in.

    Parameters
    ----------
    figure : Figure
        Empty.
    results : Results
        Of which.
    names : mapping
        Cases, and the number of each.
    label : str
        What the number is.
    quantities : sequence of Quantity
        One picture each, side by side.
    """
    figure.set_size_inches(4.6 * len(quantities), 3.8)
    for index, quantity in enumerate(quantities):
        axes = figure.add_subplot(1, len(quantities), index + 1)
        found = [
            (value, interval(results, name, quantity))
            for name, value in names.items()
            if results.runs.get(name)
        ]
        places = [value for value, _ in found]
        means = [span.mean for _, span in found]
        halves = np.nan_to_num([span.half_width for _, span in found])
        axes.errorbar(places, means, yerr=halves, fmt='o-', color=_OTHERS[index], ms=4, capsize=2)
        axes.set_xlabel(label)
        unit = f' [{quantity.unit}]' if quantity.unit else ''
        axes.set_ylabel(f'{quantity.label}{unit}')
        axes.grid(color='#E6E6E6', lw=0.8)
        axes.spines[['top', 'right']].set_visible(False)


def table_of(
    figure: Figure,
    results: Results,
    names: FloatArray | Sequence[Sequence[str]],
    rows: Sequence[str],
    columns: Sequence[str],
    corner: str,
    quantity: str,
) -> None:
    """Draw a table of means as the papers print theirs, the paper's number below ours.

    Parameters
    ----------
    figure : Figure
        Empty.
    results : Results
        Of which.
    names : nested sequence of str
        Case of each row and column.
    rows, columns : sequence of str
        Their heads.
    corner : str
        What stands in the corner.
    quantity : str
        What is shown.
    """
    figure.set_size_inches(1.3 + 1.45 * len(columns), 0.8 + 0.62 * len(rows))
    axes = figure.add_subplot()
    axes.axis('off')
    measured = results.experiment.quantity(quantity)
    published = {
        item.case: item for item in results.experiment.published if item.quantity == quantity
    }
    cells, means = [], np.full((len(rows), len(columns)), np.nan)
    for i, row in enumerate(names):
        line = []
        for j, name in enumerate(row):
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
    table = axes.table(
        cells,
        rowLabels=[f'{corner} {row}' if i == 0 else row for i, row in enumerate(rows)],
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

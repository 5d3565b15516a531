"""Draws a comparison of searches: how long targets stay missing, and differences seed by seed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from maasi_sim.experiments.comparison_tables import COMPLETE, TIME, difference
from maasi_sim.experiments.experiment import Results
from maasi_sim.experiments.statistics import array, survival

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Palette for colour-blind readers (Okabe and Ito).
_COLOURS = ('#0072B2', '#E69F00', '#009E73', '#CC79A7', '#56B4E9', '#D55E00', '#8C564B')
_LINES = ('-', '--', '-.', ':')


def draw_comparison(figure: Figure, every: Sequence[Results]) -> None:
    """Draw a row for each scenario: survival curves, and paired differences to the first case."""
    most = max(len(results.names()) for results in every)
    figure.set_size_inches(11.0, max(3.6, 1.6 + 0.4 * most) * len(every))
    axes = figure.subplots(len(every), 2, squeeze=False)
    for results, (left, right) in zip(every, axes):
        _draw_survival(left, results)
        _draw_differences(right, results)


def _style(index: int) -> tuple[str, str]:
    return _COLOURS[index % len(_COLOURS)], _LINES[index // len(_COLOURS) % len(_LINES)]


def _draw_survival(axes: Axes, results: Results) -> None:
    end = 0.0
    for index, name in enumerate(results.names()):
        durations = array(results.values(name, TIME.name))
        finished = array(results.values(name, COMPLETE.name)) > 0.0
        times, shares = survival(durations, finished)
        end = max(end, float(durations.max()))
        colour, line = _style(index)
        last = float(durations.max())
        axes.step(
            [*times, last],
            [*(100.0 * shares), 100.0 * shares[-1]],
            line,
            where='post',
            color=colour,
            lw=1.8,
            label=name,
        )
    axes.set_xlim(0.0, 1.02 * end or 1.0)
    axes.set_ylim(0.0, 103.0)
    axes.set_xlabel('time [s]')
    axes.set_ylabel('searches that still miss targets [%]')
    axes.set_title(results.experiment.name, loc='left', fontsize=10, fontweight='bold')
    axes.grid(color='#E6E6E6', lw=0.8)
    axes.spines[['top', 'right']].set_visible(False)
    axes.legend(fontsize=8, frameon=False)


def _draw_differences(axes: Axes, results: Results) -> None:
    names = results.names()
    axes.axvline(0.0, color='#222222', lw=0.8)
    for row, name in enumerate(names[1:]):
        colour, _ = _style(row + 1)
        pairs = results.pairs(name, names[0])
        ours, theirs = (array([pair[i].value(TIME.name) for pair in pairs]) for i in (0, 1))
        gaps = ours - theirs
        # Spread, always the same way, so that equal values can be seen.
        lift = np.random.default_rng(0).uniform(0.12, 0.3, len(gaps))
        axes.plot(gaps, row + lift, 'o', color=colour, ms=4, alpha=0.45, mew=0)
        mean = difference(results, name, names[0], TIME)
        axes.plot([mean.low, mean.high], [row, row], '-', color=colour, lw=3, solid_capstyle='butt')
        axes.plot([mean.mean], [row], 'D', color=colour, ms=7, mec='white')
    axes.set_yticks(range(len(names) - 1), names[1:])
    axes.set_ylim(len(names) - 1.5, -0.5)
    axes.set_xlabel(f'time to find all, minus {names[0] if names else ""} [s]')
    axes.set_title('Each seed, mean and 95 % interval', loc='left', fontsize=10)
    axes.grid(axis='x', color='#E6E6E6', lw=0.8)
    axes.spines[['top', 'right', 'left']].set_visible(False)

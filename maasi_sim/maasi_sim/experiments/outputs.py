"""Output files of an experiment beside the single runs."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import TYPE_CHECKING

import yaml

from maasi_sim.experiments.experiment import Experiment, Results
from maasi_sim.experiments.results import RunFolder, runs_text, steps_text, write_file
from maasi_sim.experiments.tables import markdown, table_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def configuration_text(results: Results, seed: int) -> str:
    """Return the configuration as YAML: choices, cases with their settings, seeds."""
    experiment = results.experiment
    numbers = sorted({run.number for runs in results.runs.values() for run in runs})
    content = {
        'experiment': experiment.name,
        'title': experiment.title,
        'seed': seed,
        'maps': {number: experiment.seed(number, seed) for number in numbers},
        'choices': [
            {'what': item.what, 'taken': item.taken, 'reason': item.reason}
            for item in experiment.choices
        ],
        'cases': {
            case.name: {
                'preset': case.preset,
                'runs': len(results.runs[case.name]),
                'settings': case.settings,
            }
            for case in results.cases
        },
    }
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)


def picture(results: Results, dpi: int = 110) -> bytes:
    """Return the experiment's figure as PNG."""
    return as_png(lambda figure: results.experiment.draw(figure, results), dpi)


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


def table_markdown(results: Results) -> str:
    """Return the tables with title, note, causes and choices."""
    experiment = results.experiment
    parts = [f'# {experiment.name}: {experiment.title}\n', described(experiment, markdown(results))]
    return '\n'.join(parts)


def described(experiment: Experiment, tables: str) -> str:
    """Return tables, note, causes and choices in Markdown."""
    parts = [tables]
    if experiment.note:
        parts.append(f'{experiment.note}\n')
    if experiment.causes:
        parts.append(f'Likely causes of differences, not tested: {experiment.causes}\n')
    if experiment.tested:
        parts.append(f'Causes of differences, tested: {experiment.tested}\n')
    if experiment.choices:
        parts.append(
            '\n'.join(
                f'- {item.what}: **{item.taken}**. {item.reason}' for item in experiment.choices
            )
            + '\n'
        )
    return '\n'.join(parts)


def write_outputs(folder: RunFolder, results: Results, seed: int) -> None:
    """Write raw runs, tables, figure and configuration.

    Raises
    ------
    NoRoom
        If one cannot be written; the runs are stored already.
    """
    runs = [run for case in results.cases for run in results.runs[case.name]]
    write_file(folder.path / 'steps.csv', steps_text(runs))
    write_file(folder.path / 'runs.csv', runs_text(runs))
    write_file(folder.path / 'table.csv', table_text(results))
    write_file(folder.path / 'table.md', table_markdown(results))
    write_file(folder.path / 'configuration.yaml', configuration_text(results, seed))
    write_file(folder.path / 'figure.png', picture(results))

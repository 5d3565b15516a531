"""The commands and their options, as their parsers have them: docs/commands.md."""

from __future__ import annotations

import argparse
import importlib
import textwrap
from collections.abc import Iterator
from pathlib import Path

from page_tables import table

from maasi_sim.run.ending import EXIT_CODES

PAGE = Path(__file__).resolve().parents[1] / 'commands.md'
HEAD = """# Commands

This page lists what each command does, its options and its exit codes. `./scripts/docs --write`
writes it from the parsers; `--help` of a command prints the same.

"""
SCRIPTS = {
    '`./scripts/demo`': 'runs the scenario `mambo_turtlebot` in lockstep; takes the options of '
    '[`run_scenario`](#run_scenario)',
    '[`./scripts/run_scenario`](#run_scenario)': 'runs, checks or replays any scenario: a file, or '
    'a name from `config/scenarios`',
    '[`./scripts/view`](#view)': 'shows a recorded run as a page, or makes a video of it '
    '([view.md](view.md))',
    '[`./scripts/team_command`](#team_command)': 'starts, pauses, resumes and stops a search, arms '
    'robots ([robots.md](robots.md))',
    '[`./scripts/compare`](#compare)': 'compares planners and filters on the same seeds '
    '([compare.md](compare.md))',
    '[`./scripts/reproduce`](#reproduce)': "runs the papers' experiments "
    '([reproduction.md](reproduction.md))',
    '[`./scripts/judge`](#judge)': "compares the planner's routes by an outside benchmark, SAREnv "
    '([judge.md](judge.md))',
    '`./scripts/search_quality`': 'compares the planners in whole searches '
    '([search_quality.md](search_quality.md))',
    '`./scripts/quality`': 'compares the filters in whole searches '
    '([filter_quality.md](filter_quality.md))',
    '`./scripts/bench`': 'measures speed against baselines of the same run',
    '`./scripts/chaos`': 'runs searches in which nodes are killed or stop responding '
    '([reliability.md](reliability.md))',
    '`./scripts/golden`': 'repeats stored searches and prints differences '
    '([repeatability.md](repeatability.md))',
    '`./scripts/test`': 'checks style, spelling and types, and runs all tests',
    '`./scripts/colcon_test`': 'tests each package alone, as `colcon test` does',
    '`./scripts/dependencies`': 'runs the fast tests with the newest or oldest dependencies',
    '`./scripts/docs`': 'builds the documentation site; `--write` writes the generated pages',
    '`./scripts/release`': 'builds and checks what goes to PyPI '
    '([how_to/release.md](how_to/release.md))',
    '`./scripts/python`': 'runs Python in the environment of the suite',
    '`./scripts/shell`': 'opens a shell, or runs a command, in the environment of the suite',
}
IN_ROS = """
In a ROS 2 workspace call `ros2 run maasi_sim run_scenario` and
`ros2 run maasi_drivers team_command`. A run writes to `runs/<stamp>/` ([report.md](report.md)).

## Exit codes of a run

"""
PARSERS = [
    'maasi_sim.run.run_options',
    'maasi_sim.run.view.view_run',
    'maasi_sim.run.view.view_node',
    'maasi_drivers.team_command',
    'maasi_drivers.calibrate_sensor',
    'maasi_drivers.measure_mambo',
    'maasi_drivers.measurement_feed_sender',
    'maasi_sim.experiments.compare',
    'maasi_sim.experiments.reproduce',
    'maasi_sim.experiments.judge',
    'maasi_sim.simulation.emulators.mambo.fake_mambo',
    'maasi_sim.simulation.emulators.mavlink.fake_mavlink_vehicle',
]


def page() -> str:
    """Return the page."""
    codes = [(str(code), meaning) for code, meaning in EXIT_CODES.items()]
    head = HEAD + table(('command', 'what it does'), SCRIPTS.items())
    text = [head + IN_ROS + table(('exit code', 'meaning'), codes)]
    for module in PARSERS:
        parser = importlib.import_module(module).build_parser()
        text.append(f'## {parser.prog}\n')
        if parser.description:
            text.append(f'{textwrap.fill(_in_one_line(parser.description), 110)}\n')
        text.append(table(('argument', 'meaning'), _rows(parser)))
    return '\n'.join(text)


def _rows(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    """Yield how each argument is written and what it means; those of subcommands too."""
    formatter = parser.formatter_class(prog=parser.prog)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for choice in action._choices_actions:
                yield f'`{choice.dest}`', _in_one_line(choice.help or '')
        elif not isinstance(action, argparse._HelpAction):
            meaning = formatter._expand_help(action) if action.help else ''
            yield f'`{_written(action)}`', _in_one_line(meaning)


def _written(action: argparse.Action) -> str:
    """Return an argument as it is written on a command line."""
    if isinstance(action.metavar, tuple):
        value = ' '.join(action.metavar)
    elif action.choices is not None and action.metavar is None:
        value = ', '.join(map(str, action.choices))
    else:
        value = action.metavar or action.dest.upper()
    if action.nargs == '+':
        value += ' ...'
    if not action.option_strings:
        return f'[{value}]' if action.nargs in ('?', '*') else value
    return action.option_strings[-1] + ('' if action.nargs == 0 else f' {value}')


def _in_one_line(text: str) -> str:
    return ' '.join(text.split()).replace('<', r'\<')


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')

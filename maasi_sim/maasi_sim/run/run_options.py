"""The options of a run: on the command line of `run_scenario`, and of `scenario.launch.py`."""

from __future__ import annotations

import argparse
import os
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from maasi_sim.arguments import Parser, positive, whole
from maasi_sim.run.cot import CotAddress, cot_address
from maasi_sim.run.ending import EXIT_CODES

LOG_LEVELS = ('debug', 'info', 'warn', 'error', 'fatal')
# Options that are arguments of a launch as well.
_LAUNCH_OPTIONS = (
    *('out', 'seed', 'rate', 'planner', 'time_limit', 'namespace', 'log_level', 'port', 'cot'),
)
_LAUNCH_FLAGS = ('lockstep', 'view')
Key = tuple[str | int, ...]  # as of a scenario file
_NAMESPACE = re.compile('[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*')


def short(path: Path) -> str:
    """Return a path relative to the working directory, if it is below."""
    here = Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


@dataclass(frozen=True)
class Options:
    """Options of a run."""

    scenario: str = ''
    out: Path | None = None
    seed: int | None = None
    lockstep: bool = False
    rate: float | None = None
    record: bool = True
    planner: str | None = None
    time_limit: float | None = None
    domain_id: int | None = None
    log_level: str | None = None
    namespace: str = ''
    replay: Path | None = None
    remap: tuple[tuple[str, str], ...] = ()
    check: bool = False
    listing: bool = False
    view: ViewOptions | None = None
    cot: CotAddress | None = None
    write_world: Path | None = None

    def overrides(self) -> dict[str, tuple[Key, Any]]:
        """Return what wins over the values of the scenario file: by option, key and value."""
        given: dict[str, tuple[Key, Any]] = {
            '--planner': (('planner', 'name'), self.planner),
            '--time-limit': (('limits', 'time'), self.time_limit),
            '--seed': (('seed',), self.seed),
        }
        return {name: item for name, item in given.items() if item[1] is not None}

    def command(self, seed: int) -> str:
        """Return the command that runs the same again."""
        words = ['./scripts/run_scenario', short(Path(self.scenario)), '--seed', str(seed)]
        words += ['--lockstep'] if self.lockstep else []
        given = {'--rate': self.rate, '--planner': self.planner, '--time-limit': self.time_limit}
        for name, value in given.items():
            words += [] if value is None else [name, str(value)]
        return shlex.join(words)


@dataclass(frozen=True)
class ViewOptions:
    """Where the page of a run is served and opened, and whether it may command robots."""

    port: int | None = None
    host: str = '127.0.0.1'
    control: bool = False
    browser: bool = True


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(
        prog='run_scenario',
        description='Run a search scenario as ROS 2 nodes, or replay a recording.',
        epilog=f'Exit codes: {", ".join(f"{code} {what}" for code, what in EXIT_CODES.items())}.',
    )
    add = parser.add_argument
    add(
        'scenario',
        nargs='?',
        default='',
        metavar='FILE',
        help='scenario file, or the name of a scenario that --list prints',
    )
    add(
        '--list',
        dest='listing',
        action='store_true',
        help='list the scenarios in config/scenarios with their descriptions and exit',
    )
    add(
        '--check',
        action='store_true',
        help='check the scenario without starting it; print its area, the estimated search time '
        'and battery charges, and cells that no robot can reach',
    )
    add('--out', type=Path, metavar='DIR', help='folder for the results (default: runs/<time>)')
    add('--seed', type=whole, metavar='N', help="random seed (default: the scenario's)")
    add('--planner', metavar='NAME', help="planner (default: the scenario's)")
    add(
        '--time-limit',
        type=positive,
        metavar='S',
        help="stop after this simulated time [s] (default: the scenario's limits.time)",
    )
    add(
        '--lockstep',
        action='store_true',
        help='run step by step at full speed; the same seed then gives the same run',
    )
    add(
        '--rate',
        type=positive,
        metavar='X',
        help='run at X times real time, without --lockstep (default: 1)',
    )
    add('--no-record', dest='record', action='store_false', help='do not record a bag')
    add('--domain-id', type=whole, metavar='N', help='use this ROS domain (default: a free one)')
    add(
        '--namespace',
        type=_namespace,
        metavar='NS',
        help='put all nodes and topics, except /clock and /diagnostics, below this namespace',
    )
    add('--log-level', choices=LOG_LEVELS, help='log level of the nodes (default: info)')
    add(
        '--replay',
        type=Path,
        metavar='BAG',
        help='run the filter on recorded measurements and compare the targets that it finds; with '
        'FILE: search in a recording of camera images and poses from any robot',
    )
    add(
        '--remap',
        type=_remapping,
        action='append',
        default=[],
        metavar='FROM:=TO',
        help='read the recorded topic FROM as TO (with FILE and --replay)',
    )
    add(
        '--cot',
        type=cot_address,
        metavar='udp://HOST:PORT',
        help='send found targets as Cursor-on-Target events to a TAK server, or to a multicast '
        'group such as udp://239.2.3.1:6969; needs environment.origin',
    )
    add(
        '--write-world',
        type=Path,
        metavar='FILE.sdf',
        help='write the scenario as a world of Gazebo and, next to it, the configuration of '
        'ros_gz_bridge, and exit',
    )
    add('--view', action='store_true', help='show the run in a browser')
    add_view_options(parser)
    return parser


def add_view_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a server of the page."""
    add = parser.add_argument
    add(
        '--port',
        type=lambda text: whole(text, most=65535),
        metavar='N',
        help='serve the page on this port, or on the next free one (default: 8420)',
    )
    add(
        '--host',
        default='127.0.0.1',
        metavar='ADDRESS',
        help='serve the page on this address (default: 127.0.0.1, this machine only); other '
        'machines need the full link including its token',
    )
    add(
        '--control',
        action='store_true',
        help='show buttons to pause, resume, send home and stop; the link contains a token',
    )
    add('--no-browser', dest='browser', action='store_false', help='do not open a browser')


def _namespace(text: str) -> str:
    name = text.strip('/')
    if not _NAMESPACE.fullmatch(name):
        raise argparse.ArgumentTypeError(
            f"read '{text[:60]}', allowed are letters, digits and underscores, not a digit first, "
            'and / between names'
        )
    return name


def _remapping(text: str) -> tuple[str, str]:
    old, sign, new = text.partition(':=')
    if not (old.strip('/') and sign and new.strip('/')):
        raise argparse.ArgumentTypeError(f"read '{text[:80]}', allowed is FROM:=TO, two topics")
    return old, new


def parse(arguments: list[str] | None) -> Options:
    """Return the options of a command line; a wrong one ends the process with 2."""
    parser = build_parser()
    given = vars(parser.parse_args(arguments))
    view = ViewOptions(*(given.pop(field.name) for field in fields(ViewOptions)))
    if not given['view'] and (view.port is not None or view.control or not view.browser):
        parser.error('--port, --control and --no-browser need --view')
    given['remap'] = tuple(given['remap'])
    given |= {'namespace': given['namespace'] or '', 'view': view if given['view'] else None}
    options = Options(**given)
    if options.listing:
        return options
    if options.write_world is not None and (
        options.check or options.replay or options.view or options.write_world.suffix != '.sdf'
    ):
        parser.error('--write-world: allowed is FILE.sdf, without --check, --replay and --view')
    if options.check and (options.replay is not None or options.view is not None):
        parser.error('--check: allowed without --replay and --view')
    if options.cot is not None and (options.check or options.replay is not None):
        parser.error('--cot: allowed without --check and --replay')
    if options.remap and not (options.replay and options.scenario):
        parser.error('--remap: allowed with a scenario and --replay BAG')
    if options.replay is None and not options.scenario:
        parser.error('give a scenario, --list or --replay BAG')
    return options


def launch_arguments() -> dict[str, tuple[str, str]]:
    """Return default (empty: left out) and description of each argument of the launch."""
    arguments = {'scenario': ('mambo_turtlebot', 'scenario file, or name of one in maasi_config')}
    for action in build_parser()._actions:
        if action.dest in _LAUNCH_OPTIONS:
            arguments[action.dest] = ('', f'{action.help}; empty: not given')
        elif action.dest in _LAUNCH_FLAGS:
            arguments[action.dest] = ('false', f'{action.help}; true or false')
    return arguments | {
        'record': ('true', 'whether a bag is recorded; true or false'),
        'rviz': ('false', 'whether RViz shows the search; true or false'),
    }


def is_true(given: Mapping[str, str], name: str) -> bool:
    """Return an argument that is true or false."""
    text = given[name].strip().lower()
    if text not in ('true', 'false'):
        raise ValueError(f"{name}: read '{given[name]}', allowed are true and false")
    return text == 'true'


def scenario_options(given: Mapping[str, str]) -> list[str]:
    """Return the command line of `run_scenario` for a launch, in the ROS domain of that."""
    values = {name: text.strip() for name, text in given.items()}
    flags = {name: is_true(given, name) for name in (*_LAUNCH_FLAGS, 'record', 'rviz')}
    if not flags['view']:
        values['port'] = ''
    # Joined by '=': a value that begins with '-' stays a value.
    words = [f'{name}={values[name]}' for name in _LAUNCH_OPTIONS if values[name]]
    words += [name for name in _LAUNCH_FLAGS if flags[name]]
    words += [] if flags['record'] else ['no_record']
    words.append(f'domain_id={os.environ.get("ROS_DOMAIN_ID") or 0}')
    options = [word.partition('=') for word in words]
    return [
        values['scenario'],
        *(f'--{name.replace("_", "-")}{sign}{value}' for name, sign, value in options),
    ]

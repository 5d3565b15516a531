"""The arguments of `scenario.launch.py`, as options of `run_scenario`."""

from __future__ import annotations

import os
from collections.abc import Mapping

# Name, default and description; empty: as run_scenario has it.
ARGUMENTS = {
    'scenario': ('mambo_turtlebot', 'scenario file, or name of one in maasi_config'),
    'out': ('', 'folder of the results; empty: runs/<time> below the working directory'),
    'seed': ('', "of all random numbers; empty: the scenario's"),
    'lockstep': ('false', 'step by step, as fast as it goes; true or false'),
    'rate': ('', 'simulated over wall time; empty: 1, in lockstep as fast as possible'),
    'record': ('true', 'whether a bag is recorded; true or false'),
    'planner': ('', "name of the planner; empty: the scenario's"),
    'time_limit': ('', "simulated time [s]; empty: the scenario's"),
    'namespace': ('', 'of all nodes and topics of the run; empty: none'),
    'follow_clock': ('false', 'whether its time is the /clock of another run; true or false'),
    'log_level': ('', 'of the nodes: debug, info, warn, error or fatal; empty: info'),
    'view': ('false', 'whether a page in the browser shows the search; true or false'),
    'port': ('', 'of the page; empty: 8420'),
    'rviz': ('false', 'whether RViz shows the search; true or false'),
}
_OPTIONS = ('out', 'seed', 'rate', 'planner', 'time_limit', 'namespace', 'log_level')
_FLAGS = ('lockstep', 'follow_clock', 'view')
_ENDINGS = {
    1: 'not all targets were found',
    2: 'wrong input',
    3: 'a node died or hung',
    4: 'the results could not be written',
    130: 'interrupted',
}


def is_true(given: Mapping[str, str], name: str) -> bool:
    """Return an argument that is true or false."""
    text = given[name].strip().lower()
    if text not in ('true', 'false'):
        raise ValueError(f"{name}: read '{given[name]}', allowed are true and false")
    return text == 'true'


def scenario_options(given: Mapping[str, str]) -> list[str]:
    """Return the command line of `run_scenario` for the arguments of a launch.

    The nodes are in the ROS domain of the launch, so that other tools see them.
    """
    values = {name: text.strip() for name, text in given.items()}
    # Joined by '=': a value that begins with '-' stays a value.
    words = [f'{name}={values[name]}' for name in _OPTIONS if values[name]]
    words += [name for name in _FLAGS if is_true(given, name)]
    if not is_true(given, 'record'):
        words.append('no_record')
    if is_true(given, 'view') and values['port']:
        words.append(f'port={values["port"]}')
    is_true(given, 'rviz')
    words.append(f'domain_id={os.environ.get("ROS_DOMAIN_ID") or 0}')
    options = [word.partition('=') for word in words]
    return [
        values['scenario'],
        *(f'--{name.replace("_", "-")}{sign}{value}' for name, sign, value in options),
    ]


def ending(code: int) -> str:
    """Return in words how `run_scenario` ended."""
    return f'run_scenario exited with {code}: {_ENDINGS.get(code, "unknown")}'

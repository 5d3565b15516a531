"""Runs of whole scenarios as processes."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from chaos_execution import processes_of
from report_check import check_report
from waiting import wait_until

from maasi_sim.run.bag import Bag

# Far more than any of the runs takes, for a machine that is busy with something else.
PATIENCE = 400.0


class Run:
    """A finished run."""

    def __init__(self, folder, code, output):
        self.folder = Path(folder)
        self.code = code
        self.output = output

    @property
    def report(self):
        return check_report(json.loads((self.folder / 'report.json').read_text()))

    @property
    def bag(self):
        return self.folder / 'bag'


def command(scenario, folder, *options):
    return [
        sys.executable,
        '-m',
        'maasi_sim.run.run_scenario',
        str(scenario),
        '--out',
        str(folder),
        *map(str, options),
    ]


def run_scenario(scenario, folder, *options, environment=None):
    done = subprocess.run(
        command(scenario, folder, *options),
        env={**os.environ, **(environment or {})},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    return Run(folder, done.returncode, done.stdout)


def wait_for(condition, what):
    wait_until(condition, lambda: time.sleep(0.05), f'{what} within {PATIENCE:g} s', PATIENCE)


def processes_with(text):
    """Return the ids of the processes whose command line has a text in it."""
    return list(processes_of(text))


def plain(message):
    """Return a message of a bag as plain values that can be compared."""
    if hasattr(message, '__dataclass_fields__'):
        names = [name for name in message.__dataclass_fields__ if name != '__msgtype__']
        return {name: plain(getattr(message, name)) for name in names}
    if isinstance(message, list):
        return [plain(item) for item in message]
    return message.tolist() if hasattr(message, 'tolist') else message


def of_topic(run, topic):
    """Return the messages of a topic in the bag of a run, as plain data."""
    with Bag(run.bag) as bag:
        return [plain(item.message) for item in bag.messages([topic])]


def replay(run, folder):
    """Replay the bag of a run; return the finished process."""
    return subprocess.run(
        [*command('mambo_turtlebot', folder)[:3], '--replay', str(run.bag)],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=PATIENCE,
        check=False,
    )

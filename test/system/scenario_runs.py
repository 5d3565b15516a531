"""Runs of whole scenarios as processes, and a node next to one."""

import json
import os
import re
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import rclpy
import yaml
from chaos_execution import processes_of
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from report_check import check_report
from std_srvs.srv import Trigger
from waiting import wait_until

from maasi_sim.run.bag import Bag
from maasi_sim.run.domain import DOMAINS, Domain, DomainError

# Far more than any of the runs takes, for a machine that is busy with something else.
PATIENCE = 400.0


class Run:
    """A run: its process while it lasts, then its exit code, output and files."""

    code = None
    output = ''

    def __init__(self, folder, process):
        self.folder = Path(folder)
        self.bag = self.folder / 'bag'
        self.process = process

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.code is None:
            self.process.kill()
            self.process.wait()

    def wait_for(self, pattern):
        """Read the output up to a line with a pattern; return that line."""
        for line in self.process.stdout:
            self.output += line
            if re.search(pattern, line):
                return line
        raise AssertionError(f'never said {pattern}: {self.output}')

    def finish(self):
        try:
            self.output += self.process.communicate(timeout=PATIENCE)[0]
        except subprocess.TimeoutExpired:
            self.process.kill()
            text = self.output + self.process.communicate()[0]
            logs = [f'{log.name}: {log.read_text()[-300:]}' for log in self.folder.glob('*.log')]
            raise AssertionError('\n'.join(['does not end', text[-3000:], *logs])) from None
        self.code = self.process.returncode
        return self

    def processes(self, node=''):
        """Return the process of a node, or those of all: files of the run are on their lines."""
        file = f'parameters/{node.strip("/").replace("/", "_")}.yaml' if node else ''
        return list(processes_of(f'{self.folder}/{file}'))

    @property
    def warnings(self):
        """Lines of its nodes that are no information."""
        lines = [line for log in self.folder.glob('*.log') for line in log.open()]
        return [line for line in lines if re.match(r'\[(WARN|ERROR|FATAL)\]', line)]

    @property
    def report(self):
        return check_report(json.loads((self.folder / 'report.json').read_text()))


def command(scenario, folder, *options):
    words = ['-m', 'maasi_sim.run.run_scenario', scenario, '--out', folder, *options]
    return [sys.executable, *map(str, words)]


def started(words, folder, environment=None, **options):
    process = subprocess.Popen(
        words,
        env={**os.environ, **(environment or {})},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **options,
    )
    return Run(folder, process)


def start(scenario, folder, *options, environment=None):
    """Start a run of a scenario: its name, its file, or its content, which is written to a file."""
    if isinstance(scenario, dict):
        file = folder.parent / 'search.yaml'
        file.write_text(yaml.safe_dump(scenario))
        scenario = file
    return started(command(scenario, folder, *options), folder, environment)


def run_scenario(scenario, folder, *options, environment=None):
    with start(scenario, folder, *options, environment=environment) as run:
        return run.finish()


def write_scenario(path, targets, start=(1.9, 1.9, 1.0), **changes):
    candidates = {'grid': [7, 7], 'spacing': 0.384, 'corner': [-0.1, -0.1]}
    content = {
        'version': 1,
        'environment': {'bounds': [[-0.3, 2.4], [-0.3, 2.4]]},
        'targets': {'positions': targets},
        'robots': {'mambo': {'type': 'mambo', 'start': [*start], 'candidates': candidates}},
        'filter': {'method': 'pmb'},
        'limits': {'time': 120.0},
    }
    path.write_text(yaml.safe_dump(content | changes))
    return path


def wait_for(condition, what):
    wait_until(condition, lambda: time.sleep(0.05), f'{what} within {PATIENCE:g} s', PATIENCE)


def plain(message):
    """Return a message of a bag as plain values that can be compared."""
    if hasattr(message, '__dataclass_fields__'):
        names = [name for name in message.__dataclass_fields__ if name != '__msgtype__']
        return {name: plain(getattr(message, name)) for name in names}
    if isinstance(message, list):
        return [plain(item) for item in message]
    return message.tolist() if hasattr(message, 'tolist') else message


def of_topic(run, topic):
    with Bag(run.bag) as bag:
        return [plain(item.message) for item in bag.messages([topic])]


def check_replay(run, folder):
    done = started([*command('', '')[:3], '--replay', str(run.bag)], folder, cwd=folder).finish()
    assert done.code == 0 and 'bit-identical' in done.output, done.output


class Operator:
    """A node in the domain of a run: it calls services, and hears topics."""

    def __init__(self, domain):
        self.options = ('--domain-id', domain)
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node('operator', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def call(self, service):
        """Call a service until it does what it is to."""
        client = self.node.create_client(Trigger, service)
        while True:
            self.until(client.service_is_ready, service)
            answer = client.call_async(Trigger.Request())
            self.until(answer.done, service)
            if answer.result().success:
                return

    def until(self, condition, what):
        wait_until(condition, lambda: self.executor.spin_once(timeout_sec=0.02), what, PATIENCE)

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@contextmanager
def reserved_domain():
    """Reserve one of the last domains, which no run takes that takes the first free one."""
    for number in reversed(DOMAINS):
        with suppress(DomainError):
            domain = Domain(number, 'reserved for a test')
            break
    with domain:
        yield domain


@contextmanager
def alongside(kind=Operator):
    """Yield an operator in a domain that is reserved for runs with its options."""
    with reserved_domain() as domain, pytest.MonkeyPatch.context() as patch:
        for name, value in domain.environment().items():
            patch.setenv(name, value)
        made = kind(domain.number)
        try:
            yield made
        finally:
            made.close()

"""Runs whose disk fills in the middle, and a run that is killed: what is left of them.

A write beyond RLIMIT_FSIZE fails (EFBIG, setrlimit(2)), and so does each write to `/dev/full`
(ENOSPC, full(4)). Neither needs a disk of its own, nor rights.
"""

import json
import os
import resource
import signal
import subprocess

import pytest
import yaml
from reserved_domain import reserved_domain
from rosgraph_msgs.msg import Clock
from run_operator import Operator
from scenario_runs import PATIENCE, command, processes_with, wait_for

from maasi_filter.ros.conversions import stamp_from_ros
from maasi_sim.run.bag import Bag

pytestmark = pytest.mark.system
# So far from each other that the run lasts much longer than until its disk is full.
SCENARIO = {
    'version': 1,
    'environment': {'bounds': [[-0.3, 6.0], [-0.3, 6.0]]},
    'targets': {'positions': [[0.0, 0.0], [5.5, 5.5], [0.0, 5.5]]},
    'robots': {
        'mambo': {
            'type': 'mambo',
            'start': [1.9, 1.9, 1.0],
            'candidates': {'grid': [16, 16], 'spacing': 0.384, 'corner': [-0.1, -0.1]},
        }
    },
    'filter': {'method': 'pmb'},
    'limits': {'time': 300.0},
}
# Little enough that the report is larger.
LITTLE = 16


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / 'scenario.yaml'
    path.write_text(yaml.safe_dump(SCENARIO))
    return path


@pytest.fixture
def start(scenario, tmp_path):
    """Start a run in the folder `run`; `elsewhere` is its folder for temporary files."""
    running = []
    elsewhere = tmp_path / 'elsewhere'
    elsewhere.mkdir()

    def make(*options, **variables):
        process = subprocess.Popen(
            command(scenario, tmp_path / 'run', *options),
            env={**os.environ, 'TMPDIR': str(elsewhere), **variables},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        running.append(process)
        return process

    yield make
    for process in running:
        process.kill()
        process.communicate()


def fill(process, folder, size=None):
    """Let no file of a run that records grow further, or beyond a size."""
    bag = folder / 'bag' / 'bag.mcap'
    wait_for(lambda: bag.exists() and bag.stat().st_size > 100_000, 'the run records')
    size = bag.stat().st_size if size is None else size
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (size, size))


def recorded(folder):
    """Return the times of the clock in a recording without its end [ns]."""
    with Bag(folder) as bag:
        assert 'the end of bag.mcap is missing' in bag.recovered or not bag.recovered
        return [stamp_from_ros(item.message.clock) for item in bag.messages(['/clock'])]


def check(process, folder):
    """Return what a run said whose recording could not be finished."""
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 4, output
    assert 'of 3 targets found' in output
    assert 'bag: writing failed: File too large' in output
    assert 'Traceback' not in output
    assert not processes_with(f'{folder}/')
    times = recorded(folder)
    assert times == sorted(times) and len(times) > 10
    return output


@pytest.mark.parametrize(
    ('full', 'size', 'said', 'place'),
    [
        # Only the recording is too large.
        ((), None, '', 'run'),
        (
            ('part_report.json', 'filter_node.log', 'sim_node.log'),
            None,
            'the report cannot be written: No space left on device',
            'elsewhere',
        ),
        ((), LITTLE, 'the report cannot be written: File too large', 'nowhere'),
    ],
)
def test_a_run_that_fills_its_disk_reports_where_it_can(start, tmp_path, full, size, said, place):
    folder, elsewhere = tmp_path / 'run', tmp_path / 'elsewhere'
    folder.mkdir()
    for name in full:
        (folder / name).symlink_to('/dev/full')
    process = start('--lockstep')
    fill(process, folder, size)
    output = check(process, folder)
    assert said in output
    reports = [path for base in (folder, elsewhere) for path in base.rglob('report.json')]
    if place == 'nowhere':
        assert 'report: nowhere' in output and reports == []
    else:
        (report,) = reports
        assert f'report: {"" if place == "run" else report.parent}' in output
        assert json.loads(report.read_text())['end_reason'] == 'not_recorded'
        assert report.relative_to(tmp_path).parts[0] == place
    assert len(list(elsewhere.glob('*'))) == (place == 'elsewhere')


class Witness(Operator):
    """Hears the clock of a run."""

    def __init__(self, domain):
        super().__init__(domain)
        self.time = 0
        self.node.create_subscription(Clock, '/clock', self.hear, 10)

    def hear(self, message):
        self.time = max(self.time, stamp_from_ros(message.clock))

    def wait_for(self, seconds):
        self.until(lambda: self.time >= seconds * 1e9, f'{seconds} s of the clock')


def test_a_run_that_is_killed_leaves_all_but_its_last_second(start, tmp_path, monkeypatch):
    folder = tmp_path / 'run'
    with reserved_domain() as domain:
        for name, value in domain.environment().items():
            monkeypatch.setenv(name, value)
        # Half as fast as the time of the wall: that is what the promise is about.
        process = start('--domain-id', domain.number, '--rate', '0.5')
        witness = Witness(domain)
        witness.wait_for(3.0)
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE)
        wait_for(lambda: not processes_with(f'{folder}/'), 'all nodes end')
        times = recorded(folder)
        witness.close()
    assert times == sorted(times)
    assert times[-1] >= witness.time - 0.5e9
    assert not (folder / 'report.json').exists()
    with Bag(folder) as bag:
        assert bag.scenario()['scenario']['robots'].keys() == {'mambo'}
        assert bag.counts['/mambo/state'] > 0

"""Runs whose disk fills in the middle, and a run that is killed: what is left of them."""

import json
import resource
import signal
import tempfile
from types import SimpleNamespace

import pytest
from matplotlib.figure import Figure
from rosgraph_msgs.msg import Clock
from scenario_runs import PATIENCE, alongside, start, wait_for, write_scenario

from maasi_filter.ros.conversions import stamp_from_ros
from maasi_sim.run.bag import Bag
from maasi_sim.run.report_files import store_report

pytestmark = pytest.mark.system
LITTLE = 16  # little enough that the report is larger


@pytest.fixture
def scenario(tmp_path):
    """Return a search that lasts much longer than until its disk is full."""
    return write_scenario(
        tmp_path / 'scenario.yaml',
        [[0.0, 0.0], [5.5, 5.5], [0.0, 5.5]],
        environment={'bounds': [[-0.3, 6.0], [-0.3, 6.0]]},
        limits={'time': 300.0},
    )


def recorded(folder):
    """Return the times of the steps in a recording without its end [ns]."""
    with Bag(folder) as bag:
        assert 'the end of bag.mcap is missing' in bag.recovered or not bag.recovered
        times = [stamp_from_ros(item.message.stamp) for item in bag.messages(['/lockstep/step'])]
    assert times == sorted(times) and len(times) > 10
    return times


@pytest.mark.parametrize('room', [True, False])
def test_a_run_that_fills_its_disk_reports_where_it_can(scenario, tmp_path, room):
    """There is room for the report, but neither for the recording nor for logs; or for nothing."""
    folder, elsewhere = tmp_path / 'run', tmp_path / 'elsewhere'
    folder.mkdir()
    elsewhere.mkdir()
    for name in ('filter_node.log', 'sim_node.log') if room else ():
        (folder / name).symlink_to('/dev/full')
    with start(scenario, folder, '--lockstep', environment={'TMPDIR': str(elsewhere)}) as run:
        file = run.bag / 'bag.mcap'
        wait_for(lambda: file.exists() and file.stat().st_size > 100_000, 'the run records')
        # No file of the run grows further, or beyond the size.
        size = file.stat().st_size if room else LITTLE
        resource.prlimit(run.process.pid, resource.RLIMIT_FSIZE, (size, size))
        run.finish()
    assert run.code == 4, run.output
    assert 'of 3 targets found' in run.output
    assert 'bag: writing failed: File too large' in run.output
    assert 'Traceback' not in run.output
    assert not run.processes()
    recorded(folder)
    report = folder / 'report.json'
    if room:
        assert '"end_reason": "not_recorded"' in report.read_text()
    else:
        assert 'cannot write the report: File too large' in run.output
        assert 'report: not written' in run.output and not report.exists()
    assert list(elsewhere.iterdir()) == []


def test_a_report_for_which_its_folder_has_no_room_is_elsewhere(tmp_path, monkeypatch):
    folder, elsewhere = tmp_path / 'run', tmp_path / 'elsewhere'
    folder.mkdir()
    elsewhere.mkdir()
    (folder / 'part_report.json').symlink_to('/dev/full')
    monkeypatch.setattr(tempfile, 'tempdir', str(elsewhere))
    mission = SimpleNamespace(report=dict, tables=lambda _: {}, figure=lambda _: Figure())
    report, place, problem = store_report(mission, {'found': 3}, folder)
    assert problem == f'{folder}: cannot write the report: No space left on device'
    assert place.parent == elsewhere and not (folder / 'report.json').exists()
    assert json.loads((place / 'report.json').read_text()) == report == {'found': 3}


def test_a_run_that_is_killed_leaves_all_but_its_last_second(scenario, tmp_path):
    heard = [0]
    with alongside() as operator:
        operator.node.create_subscription(
            Clock, '/clock', lambda message: heard.append(stamp_from_ros(message.clock)), 10
        )
        # Half as fast as the time of the wall: that is what the promise is about.
        options = (*operator.options, '--rate', '0.5')
        with start(scenario, tmp_path / 'run', *options) as run:
            operator.until(lambda: max(heard) >= 2e9, '2 s of the clock')
            run.process.send_signal(signal.SIGKILL)
            run.process.wait(PATIENCE)
            wait_for(lambda: not run.processes(), 'all nodes end')
    assert recorded(run.folder)[-1] >= max(heard) - 0.5e9
    assert not (run.folder / 'report.json').exists()
    with Bag(run.folder) as bag:
        assert bag.scenario()['scenario']['robots'].keys() == {'mambo'}
        assert bag.counts['/mambo/state'] > 0

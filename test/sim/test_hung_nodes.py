"""Free runs in which the executor's thread of a node is busy for ever: the process lives."""

import pytest
from test_run_scenario import Run, scenario

__all__ = ['scenario']

pytestmark = pytest.mark.system


def test_a_node_in_an_endless_loop_ends_a_free_run_and_is_named(tmp_path, scenario):
    script = {'found': 0, 'filter_node': {'fault': 'loop', 'fault_step': 20}}
    path = scenario(limits={'time': 120.0, 'start': 60.0, 'silence': 90.0})
    run = Run(tmp_path / 'run', path, '--no-record', script=script)
    code, output = run.wait()
    assert code == 3, output
    assert '/filter_node hangs: no heartbeat for 4.' in output
    assert run.report['end_reason'] == 'node_hung'
    assert run.nodes() == []


def test_a_node_in_an_endless_loop_is_killed_and_started_again(tmp_path, scenario):
    marker = tmp_path / 'looped'
    fault = {'fault': 'loop', 'fault_step': 5, 'marker': str(marker)}
    limits = {'time': 120.0, 'start': 60.0, 'silence': 90.0}
    path = scenario(on_exit='respawn', limits=limits)
    run = Run(tmp_path / 'run', path, script={'filter_node': fault})
    code, output = run.wait()
    assert code == 0, output
    assert 'it is killed' in output and 'it is restarted' in output
    events = [item['event'] for item in run.report['events'] if 'node' in item]
    assert events == ['hung', 'restarted']

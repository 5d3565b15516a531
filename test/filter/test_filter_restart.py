"""A filter node that died goes on after its last batch, or at least with what was found."""

import pytest
from test_filter_node import running, seen_from_a

from maasi_filter import filter_node
from maasi_filter.make_filter import load_state
from maasi_filter.ros.qos import LATCHED
from maasi_msgs.msg import FoundTargetArray


def measured_once(team, until, number):
    """Have `a` see what it sees, without other batches in between."""
    before = len(team.updates)
    team.counts['a'] = number - 1
    team.measure(number, ['a'], {'a': [(0.3, 0.5), (0.25, -1.0)]})
    until(lambda: len(team.updates) > before and team.updates[-1].batch_id == number)


def test_a_restarted_node_goes_on_after_its_last_batch_to_the_bit(tmp_path):
    with running() as (_, team, until):
        seen_from_a(team, until, range(1, 13))
        expected = list(team.updates)
        targets = list(team.found[-1].targets)
    assert len(targets) == 2
    options = {'save_file': str(tmp_path / 'runs' / 'state'), 'save_batches': True}
    updates = []
    # Each of these is destroyed without being told to end.
    for first, last in ((1, 1), (2, 8), (9, 12)):
        with running(**options) as (_, team, until):
            if first > 1:
                # Latched again, with the last update, before anything new has come.
                until(lambda: team.updates and team.found)
                assert team.updates[0] == updates[-1]
                assert len(team.found[0].targets) == team.updates[0].found
                team.updates.clear()
            for number in range(first, last + 1):
                measured_once(team, until, number)
            updates += list(team.updates)
            until(lambda: team.found)
            again = list(team.found[-1].targets)
    assert updates == expected
    assert again == targets


def test_a_batch_that_comes_again_after_a_restart_is_not_processed_twice(tmp_path):
    options = {'save_file': str(tmp_path / 'state'), 'save_batches': True}
    with running(**options) as (_, team, until):
        seen_from_a(team, until, [1, 2])
    with running(**options) as (node, team, until):
        until(lambda: team.updates)
        team.counts['a'] = 1
        team.measure(2, ['a'], {'a': [(0.3, 0.5), (0.25, -1.0)]})
        measured_once(team, until, 3)
        assert [update.batch_id for update in team.updates] == [2, 3]
        assert not node.dropped


def test_a_state_that_cannot_be_used_is_set_aside(tmp_path):
    options = {'save_file': str(tmp_path / 'state'), 'save_batches': True}
    with running(**options) as (_, team, until):
        seen_from_a(team, until, [1])
    content = bytearray((tmp_path / 'state').read_bytes())
    content[-20] ^= 1
    (tmp_path / 'state').write_bytes(bytes(content))
    with running(**options) as (_, team, until):
        seen_from_a(team, until, [1, 2])
        assert (tmp_path / 'state.refused').read_bytes() == bytes(content)
        assert load_state(options['save_file'])[1].batch == 2


def test_a_new_search_forgets_the_file(tmp_path):
    options = {'save_file': str(tmp_path / 'state'), 'save_batches': True}
    with running(**options) as (node, team, until):
        seen_from_a(team, until, [1])
        node.reset()
        assert not (tmp_path / 'state').exists()


def found_before():
    """Return what a node without state is to take over: eight targets, and their ids."""
    with running() as (_, team, until):
        seen_from_a(team, until, range(1, 9))
        until(lambda: len(team.found[-1].targets) == 2)
        kept = team.found[-1]
    for number, target in enumerate(kept.targets, start=1):
        # Ids need not be in a row.
        target.id = 3 * number
    return kept


def test_a_node_without_state_takes_found_targets_from_the_latched_topic():
    kept = found_before()
    with running() as (node, team, until):
        publisher = team.node.create_publisher(FoundTargetArray, 'found_targets/kept', LATCHED)
        until(lambda: node.count_publishers('/found_targets/kept') == 1)
        # The batch waits for the message: a new target would get the id of a kept one.
        team.measure(20, ['a'], {'a': [(0.3, 0.5), (0.25, -1.0), (0.4, 2.0)]})
        until(lambda: 20 in node._batches.pending and node._batches.pending[20].complete)
        assert not team.updates
        publisher.publish(kept)
        until(lambda: team.updates and team.found)
        assert team.updates[0].found == 2
        assert [target.id for target in team.found[0].targets] == [3, 6]
        for known, before in zip(team.found[0].targets, kept.targets):
            assert known.batch_id == before.batch_id
            # The batch may have refined it.
            assert abs(known.position.x - before.position.x) < 0.01
        for number in range(21, 32):
            team.measure(number, ['a'], {'a': [(0.3, 0.5), (0.25, -1.0), (0.4, 2.0)]})
            until(lambda number=number: team.updates[-1].batch_id == number)
        until(lambda: len(team.found[-1].targets) == 3)
        # The third is new, and the two from before are not found again.
        assert [target.id for target in team.found[-1].targets] == [3, 6, 7]
        # Later ones hold what this node has found itself.
        publisher.publish(FoundTargetArray(header=kept.header, targets=[]))
        measured_once(team, until, 40)
        assert team.updates[-1].found == 3


@pytest.mark.parametrize('fault', ['frame', 'nan', 'twice'])
def test_kept_targets_that_cannot_be_used_are_dropped(fault):
    kept = found_before()
    if fault == 'frame':
        kept.header.frame_id = 'odom'
    elif fault == 'nan':
        kept.targets[0].position.x = float('nan')
    else:
        kept.targets[0].id = kept.targets[1].id
    with running() as (node, team, until):
        publisher = team.node.create_publisher(FoundTargetArray, 'found_targets/kept', LATCHED)
        publisher.publish(kept)
        until(lambda: node.dropped['bad found targets'] == 1)
        seen_from_a(team, until, [1])


def test_the_wait_for_kept_targets_has_a_bound(monkeypatch):
    monkeypatch.setattr(filter_node, '_KEPT_PATIENCE', 0.5)
    with running() as (node, team, until):
        team.node.create_publisher(FoundTargetArray, 'found_targets/kept', LATCHED)
        until(lambda: node.count_publishers('/found_targets/kept') == 1)
        seen_from_a(team, until, [1, 2])

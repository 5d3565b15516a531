"""A filter node that died goes on after its last batch, or at least with what was found."""

import math
from copy import deepcopy

import pytest
from test_filter_node import running

from maasi_filter import filter_node
from maasi_filter.make_filter import load_state
from maasi_filter.ros.qos import LATCHED
from maasi_msgs.msg import FoundTargetArray

THREE = {'a': [(0.3, 0.5), (0.25, -1.0), (0.4, 2.0)]}


@pytest.fixture
def options(tmp_path):
    return {'save_file': str(tmp_path / 'runs' / 'state'), 'save_batches': True}


def test_a_restarted_node_goes_on_after_its_last_batch_to_the_bit(options):
    with running() as team:
        team.see(*range(1, 13))
        expected, targets = list(team.updates), list(team.found[-1].targets)
    assert len(targets) == 2
    updates = []
    # Each of these is destroyed without being told to end.
    for first, last in ((1, 1), (2, 8), (9, 12)):
        with running(**options) as team:
            if first > 1:
                # Latched again, with the last update, before anything new has come.
                team.until(lambda: team.updates and team.found)
                assert team.updates.pop() == updates[-1]
                assert len(team.found[0].targets) == updates[-1].found
                # A batch that comes again is not processed twice.
                team.counts['a'] = first - 2
                team.measure(first - 1, {'a': []})
            team.see(*range(first, last + 1))
            assert not team.tested.dropped
            updates += team.updates
            team.until(lambda: team.found)
            again = list(team.found[-1].targets)
    assert updates == expected
    assert again == targets


def test_a_state_that_cannot_be_used_is_set_aside(options, tmp_path):
    file = tmp_path / 'runs' / 'state'
    with running(**options) as team:
        team.see(1)
    content = bytearray(file.read_bytes())
    content[-20] ^= 1
    file.write_bytes(bytes(content))
    with running(**options) as team:
        team.see(1, 2)
        assert file.with_name('state.refused').read_bytes() == bytes(content)
        assert load_state(file)[1].batch == 2
        # A new search forgets the file.
        team.tested.reset()
        assert not file.exists()


@pytest.fixture
def kept():
    """Return what a node without state is to take over: two targets, with ids not in a row."""
    with running() as team:
        team.see(*range(1, 9))
        team.until(lambda: len(team.found[-1].targets) == 2)
        kept = team.found[-1]
    for number, target in enumerate(kept.targets, start=1):
        target.id = 3 * number
    return kept


def test_a_node_without_state_takes_found_targets_from_the_latched_topic(kept):
    with running() as team:
        publisher = team.node.create_publisher(FoundTargetArray, 'found_targets/kept', LATCHED)
        team.until(lambda: team.tested.count_publishers('/found_targets/kept') == 1)
        # The batch waits for the message: a new target would get the id of a kept one.
        team.measure(20, THREE)
        pending = team.tested.batches.pending
        team.until(lambda: 20 in pending and not pending[20].missing)
        assert not team.updates
        publisher.publish(kept)
        team.until(lambda: team.updates and team.found)
        assert team.updates[0].found == 2
        assert [target.id for target in team.found[0].targets] == [3, 6]
        for known, before in zip(team.found[0].targets, kept.targets):
            assert known.batch_id == before.batch_id
            # The batch may have refined it.
            assert abs(known.position.x - before.position.x) < 0.01
        for number in range(21, 32):
            team.step(number, THREE)
        team.until(lambda: len(team.found[-1].targets) == 3)
        # The third is new, and the two from before are not found again.
        assert [target.id for target in team.found[-1].targets] == [3, 6, 7]
        # Later ones hold what this node has found itself.
        publisher.publish(FoundTargetArray(header=kept.header, targets=[]))
        assert team.step(40, THREE).found == 3


def test_kept_targets_that_cannot_be_used_are_dropped_and_the_wait_for_them_has_a_bound(
    kept, monkeypatch
):
    monkeypatch.setattr(filter_node, '_KEPT_PATIENCE', 0.5)
    frame, nan, twice = (deepcopy(kept) for _ in range(3))
    frame.header.frame_id = 'odom'
    nan.targets[0].position.x = math.nan
    twice.targets[0].id = twice.targets[1].id
    with running() as team:
        publisher = team.node.create_publisher(FoundTargetArray, 'found_targets/kept', LATCHED)
        team.until(lambda: team.tested.count_publishers('/found_targets/kept') == 1)
        team.see(1)
        for number, message in enumerate((frame, nan, twice), start=1):
            team.tested.kept_received = False
            publisher.publish(message)
            team.until(lambda n=number: team.tested.dropped['bad found targets'] == n)
        team.see(2)

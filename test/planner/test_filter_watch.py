"""The planner holds all robots while the filter does not answer, and goes on when it does."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.action import CancelResponse
from test_planner_node import ROBOTS, begin, running

from maasi_filter.ros.qos import LATCHED
from maasi_msgs.msg import FoundTarget, FoundTargetArray
from maasi_planner.node.filter_guard import FilterWatch


def test_silence_is_that_of_heartbeats_and_of_the_oldest_open_batch():
    watch = FilterWatch(4.0)
    assert not watch.problem(1000.0)
    watch.beat(10.0)
    assert not watch.problem(13.9)
    assert watch.problem(14.1) == 'no heartbeat of the filter for 4.1 s'
    # A planner that stood still itself blames nobody.
    watch.stalled(30.0)
    assert not watch.problem(43.9)
    watch = FilterWatch(4.0)
    watch.asked(1, 10.0)
    watch.asked(2, 13.0)
    assert 'batch 1' in watch.problem(14.1)
    watch.answered(1)
    assert not watch.problem(14.1)
    watch.asked(3, 14.0)
    watch.stalled(30.0)
    assert not watch.problem(46.9) and watch.problem(47.1)
    # Updates come in the order of batches: those before will not come any more.
    watch.answered(3)
    assert not watch.problem(100.0)
    never = FilterWatch(0.0)
    never.asked(1, 0.0)
    assert not never.problem(1e6)


def planner_status(team):
    """Return the last diagnostics of the planner."""
    return next((item for item in team.diagnostics[::-1] if 'planner_node' in item.name), None)


@pytest.mark.parametrize('silent', ['updates', 'heartbeat'])
def test_robots_are_held_until_the_filter_answers_again(silent):
    # Long enough for a heartbeat of each second on a busy machine.
    with running(filter_timeout=4.0, others={}) as (node, team, until):
        cancelled = []
        for server in team.servers:

            def cancel(handle):
                cancelled.append(handle)
                return CancelResponse.ACCEPT

            server.register_cancel_callback(cancel)
        beats = team.node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        beat = DiagnosticArray(status=[DiagnosticStatus(name='/team')])
        until(lambda: '/team' in node._guard.names and beats.get_subscription_count())
        begin(node, team, until)
        until(lambda: team.batches)

        def answer():
            last = team.batches[-1]
            team.update(last.id, last.members)

        if silent == 'heartbeat':
            beats.publish(beat)
            answer()
        until(lambda: planner_status(team) and planner_status(team).level == b'\x02')
        assert 'robots are held: no ' in planner_status(team).message
        until(lambda: len(cancelled) == len([name for name in ROBOTS if team.goals[name]]))
        decisions = len(team.decisions)
        for step in (40, 60):
            for name in ROBOTS:
                team.state(name, step)
            until(lambda step=step: node._taken_step == step)
        assert len(team.decisions) == decisions
        batches = len(team.batches)
        if silent == 'updates':
            # It is asked for again, so that a restarted filter can answer.
            until(lambda: len(team.batches) > batches)
            assert team.batches[-1] == team.batches[batches - 1]
        else:
            beats.publish(beat)
        answer()
        until(lambda: not node._held)
        for name in ROBOTS:
            team.state(name, 80)
        until(lambda: len(team.decisions) > decisions)


def test_found_targets_are_kept_for_a_filter_that_starts_again():
    with running(others={}) as (_, team, until):
        kept = []
        team.node.create_subscription(FoundTargetArray, 'found_targets/kept', kept.append, LATCHED)
        until(lambda: kept)
        assert kept[0].targets == []
        publisher = team.node.create_publisher(FoundTargetArray, 'found_targets', LATCHED)
        until(lambda: publisher.get_subscription_count())
        publisher.publish(
            FoundTargetArray(batch_id=7, targets=[FoundTarget(id=1), FoundTarget(id=2)])
        )
        until(lambda: len(kept[-1].targets) == 2)
        refined = FoundTarget(id=2, measurement=5)
        publisher.publish(FoundTargetArray(batch_id=8, targets=[refined]))
        until(lambda: kept[-1].batch_id == 8)
        # Kept once, kept for good.
        assert kept[-1].targets == [FoundTarget(id=1), refined]

"""The life cycle of every type of node: cleanup undoes configure, which reads parameters again."""

import time
from collections import Counter

import pytest
from node_kinds import KINDS
from rclpy.parameter import Parameter
from waiting import wait_until

from maasi_filter.ros.run_node import executor_of

CYCLES = 5


def made_by(node):
    """Return how many entities of each kind a node has, as it counts them itself."""
    return {
        kind: len(list(getattr(node, kind)))
        for kind in ('publishers', 'subscriptions', 'services', 'clients', 'timers', 'waitables')
    }


def in_graph(node):
    """Return how many endpoints a node has under each topic and service, as others see them."""
    counts = Counter()
    own = node.get_name(), node.get_namespace()
    for topic, _ in node.get_topic_names_and_types():
        for kind in ('publisher', 'subscription'):
            infos = getattr(node, f'get_{kind}s_info_by_topic')(topic)
            counts[kind, topic] += sum((i.node_name, i.node_namespace) == own for i in infos)
    for kind in ('service', 'client'):
        names = getattr(node, f'get_{kind}_names_and_types_by_node')(*own)
        counts.update({(kind, name): getattr(node, f'count_{kind}s')(name) for name, _ in names})
    return +counts


def unknown(node):
    """Return the endpoints of which the graph holds another number than the node has itself."""
    counts, own = in_graph(node), Counter()
    for kind in ('publisher', 'subscription'):
        own.update((kind, item.topic_name) for item in getattr(node, f'{kind}s'))
    for kind in ('service', 'client'):
        own.update((kind, item.service_name) for item in getattr(node, f'{kind}s'))
    return {
        key: (number, counts[key])
        for key, number in own.items()
        if counts[key] != number and '/_' not in key[1]
    }


def wait_until_known(node, turn=lambda: time.sleep(0.01)):
    wait_until(lambda: not unknown(node), turn, lambda: f'own number, in graph: {unknown(node)}')


@pytest.mark.parametrize('kind', KINDS)
def test_after_some_cycles_a_node_has_the_same_entities(context, kind):
    node = KINDS[kind].make(context)
    executor = executor_of(node, context)

    def spin():
        executor.spin_once(0.01)

    wait_until_known(node)
    unconfigured = made_by(node)
    assert node.trigger_configure().name == 'SUCCESS', node.problem
    wait_until_known(node)
    waitables = set(node.waitables)
    assert node.trigger_cleanup().name == 'SUCCESS', node.problem
    wait_until_known(node, spin)
    # Services and actions live as long as the node: the executor crashes without its waitables.
    assert set(node.waitables) == waitables
    cleaned = made_by(node), in_graph(node)
    for entities in ('publishers', 'timers', 'clients'):
        assert cleaned[0][entities] == unconfigured[entities]
    assert node.trigger_configure().name == 'SUCCESS', node.problem
    wait_until_known(node)
    configured = made_by(node), in_graph(node)
    assert configured[0]['publishers'] > unconfigured['publishers']
    # The recorder looks for topics after it has discovered the last publisher of each node.
    *_, step, ready = [item.topic_name for item in node.publishers]
    assert ready.endswith('lockstep/ready')
    assert step.endswith('lockstep/step') or 'sim' not in kind
    for _ in range(CYCLES):
        for step in ('activate', 'deactivate', 'cleanup', 'configure'):
            assert getattr(node, f'trigger_{step}')().name == 'SUCCESS', (step, node.problem)
            assert step != 'deactivate' or made_by(node)['timers'] == configured[0]['timers']
            executor.spin_once(0.0)
    wait_until(
        lambda: (made_by(node), in_graph(node)) == configured,
        spin,
        lambda: f'{made_by(node)}, {in_graph(node)}, configured: {configured}',
    )
    assert node.trigger_cleanup().name == 'SUCCESS'
    wait_until(lambda: (made_by(node), in_graph(node)) == cleaned, spin)
    executor.shutdown()
    node.destroy_node()


def test_a_configure_that_fails_leaves_nothing_and_can_be_repeated(context):
    node = KINDS['sim'].make(context, scenario='nowhere.yaml')
    before = made_by(node)
    assert node.trigger_configure().name == 'FAILURE'
    assert 'nowhere.yaml' in node.problem
    assert made_by(node) == before
    changed = node.set_parameters([Parameter('scenario', value='mambo_turtlebot')])
    assert changed[0].successful
    assert node.trigger_configure().name == 'SUCCESS', node.problem
    node.destroy_node()


def test_a_timer_that_is_destroyed_is_not_called_any_more(context):
    node = KINDS['guard'].make(context)
    executor = executor_of(node, context)
    called, timers = [], []

    def fire():
        called.append(len(timers))
        while timers:
            node.destroy_timer(timers.pop())

    wait_until_known(node)
    executor.spin_once(0.1)
    timers += [node.create_wall_timer(0.05, fire) for _ in range(5)]
    executor.spin_once(0.0)
    # All are due at once, and the first one that is called destroys the others.
    time.sleep(0.2)
    wait_until(lambda: called, lambda: executor.spin_once(0.01))
    for _ in range(20):
        executor.spin_once(0.01)
    assert called == [5]
    executor.shutdown()
    node.destroy_node()

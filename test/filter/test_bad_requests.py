"""Requests to the services that rclpy makes, on which it raises: the node answers and goes on."""

import threading

import pytest
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import GetParameterTypes, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from waiting import wait_until

from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.node_settings import NodeSettings
from maasi_filter.ros.run_node import executor_of


@pytest.fixture
def node(context):
    """Return a node whose executor runs in a thread; it keeps what it raised."""
    made = LockstepLifecycleNode('searcher', NodeSettings, context=context)
    executor = executor_of(made, context)
    ended = threading.Event()
    made.raised = []

    def spin():
        while not ended.is_set():
            try:
                executor.spin_once(0.05)
            except Exception as error:
                made.raised.append(error)
                return

    thread = threading.Thread(target=spin)
    thread.start()
    yield made
    ended.set()
    thread.join()
    made.destroy_node()


@pytest.fixture
def ask(context, node):
    user = Node('user', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(user)

    def turn():
        assert not node.raised, node.raised
        executor.spin_once(timeout_sec=0.05)

    def call(kind, service, request):
        client = user.create_client(kind, service)
        wait_until(client.service_is_ready, turn, f'no {service}')
        answer = client.call_async(request)
        wait_until(answer.done, turn, f'no answer of {service}')
        return answer.result()

    yield call
    executor.shutdown()
    user.destroy_node()


def test_bad_requests_are_answered_and_counted(node, ask):
    # An undeclared parameter, a value of an unknown type, no such transition.
    types = GetParameterTypes.Request(names=['nothing'])
    value = Parameter(name='seed', value=ParameterValue(type=77))
    transition = ChangeState.Request()
    transition.transition.id = 200
    ask(GetParameterTypes, 'searcher/get_parameter_types', types)
    ask(SetParameters, 'searcher/set_parameters', SetParameters.Request(parameters=[value]))
    assert not ask(ChangeState, 'searcher/change_state', transition).success
    assert node.dropped['bad request'] == 3
    # Good ones are answered as before.
    types.names = ['use_sim_time']
    assert list(ask(GetParameterTypes, 'searcher/get_parameter_types', types).types) == [1]
    assert node.dropped['bad request'] == 3

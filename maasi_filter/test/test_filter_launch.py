"""`filter.launch.py` starts a filter that becomes active, and that ends with the launch."""

import json
import tempfile
import unittest
import uuid
from pathlib import Path

import pytest

from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import flatten

launch_testing = pytest.importorskip('launch_testing', reason='comes with ROS 2, not with wheels')

FILE = Path(__file__).resolve().parents[1] / 'launch' / 'filter.launch.py'
# No other node has it, whatever else runs in this domain.
TEAM = f'test_{uuid.uuid4().hex}'
PATIENCE = 120.0
SENSOR = {
    'detection': {'kind': 'box', 'probability': 0.98, 'lower': [-0.5, -0.5], 'upper': [0.5, 0.5]},
    'noise': {'range': 0.01, 'bearing': 0.03},
}
SETTINGS = FilterNodeSettings.model_validate(
    {'environment': {'bounds': [[0.0, 2.0], [0.0, 2.0]]}, 'robots': {'a': {'sensor': SENSOR}}}
)


@pytest.mark.launch_test
def generate_test_description():
    from launch import LaunchDescription
    from launch.actions import IncludeLaunchDescription, SetEnvironmentVariable
    from launch.launch_description_sources import PythonLaunchDescriptionSource
    from launch_testing.actions import ReadyToTest

    with tempfile.NamedTemporaryFile('w', suffix='.yaml', delete=False) as file:
        json.dump({'/**': {'ros__parameters': flatten(SETTINGS)}}, file)  # JSON is YAML too
    included = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(FILE)),
        launch_arguments={'params_file': file.name, 'namespace': TEAM}.items(),
    )
    loopback = SetEnvironmentVariable('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    return LaunchDescription([loopback, included, ReadyToTest()]), {'parameters': file.name}


class TestRunning(unittest.TestCase):
    def test_the_filter_becomes_active(self, parameters):
        import rclpy
        from lifecycle_msgs.msg import State
        from lifecycle_msgs.srv import GetState

        rclpy.init()
        try:
            node = rclpy.create_node('observer', namespace=TEAM)
            client = node.create_client(GetState, 'filter_node/get_state')
            assert client.wait_for_service(PATIENCE)
            state = None
            deadline = node.get_clock().now().nanoseconds + PATIENCE * 1e9
            while state != State.PRIMARY_STATE_ACTIVE:
                assert node.get_clock().now().nanoseconds < deadline, f'state {state}'
                answer = client.call_async(GetState.Request())
                rclpy.spin_until_future_complete(node, answer, timeout_sec=PATIENCE)
                state = answer.result().current_state.id
        finally:
            rclpy.shutdown()
            Path(parameters).unlink()


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    def test_it_ends_as_intended(self, proc_info):
        from launch_testing.asserts import assertExitCodes

        assertExitCodes(proc_info)

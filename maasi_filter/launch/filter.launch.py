"""The filter node with a parameter file."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode


def generate_launch_description() -> LaunchDescription:
    """Return the filter node; it configures and activates itself by default (`autostart`)."""
    return LaunchDescription(
        [
            DeclareLaunchArgument('params_file', description='Parameters of the node (YAML)'),
            DeclareLaunchArgument('namespace', default_value='', description='Of the team'),
            LifecycleNode(
                package='maasi_filter',
                executable='filter_node',
                name='filter_node',
                namespace=LaunchConfiguration('namespace'),
                parameters=[LaunchConfiguration('params_file')],
                output='screen',
            ),
        ]
    )

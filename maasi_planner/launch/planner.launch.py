"""The planner node with a parameter file."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode


def generate_launch_description() -> LaunchDescription:
    """Return the planner node; it configures and activates itself by default (`autostart`)."""
    return LaunchDescription(
        [
            DeclareLaunchArgument('params_file', description='Parameters of the node (YAML)'),
            DeclareLaunchArgument('namespace', default_value='', description='Of the team'),
            LifecycleNode(
                package='maasi_planner',
                executable='planner_node',
                name='planner_node',
                namespace=LaunchConfiguration('namespace'),
                parameters=[LaunchConfiguration('params_file')],
                output='screen',
            ),
        ]
    )

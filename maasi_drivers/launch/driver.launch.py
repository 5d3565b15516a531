"""The driver of one robot, with its guard where it is commanded by a topic."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import LifecycleNode, Node


def generate_launch_description() -> LaunchDescription:
    """Return the nodes of one robot, in its namespace."""
    robot, executable = LaunchConfiguration('robot'), LaunchConfiguration('executable')
    return LaunchDescription(
        [
            DeclareLaunchArgument('robot', description='Name of the robot: its namespace'),
            DeclareLaunchArgument(
                'executable',
                default_value='turtlebot_driver',
                description='turtlebot_driver, mambo_driver, mavlink_driver, ...',
            ),
            DeclareLaunchArgument('params_file', description='Parameters of the driver (YAML)'),
            DeclareLaunchArgument(
                'guard',
                # Only what listens to cmd_vel can be stopped by it.
                default_value=PythonExpression(
                    ["not any(word in '", executable, "' for word in ('mavlink', 'onboard'))"]
                ),
                description='Whether to guard it',
            ),
            LifecycleNode(
                package='maasi_drivers',
                executable=executable,
                name='driver',
                namespace=robot,
                parameters=[LaunchConfiguration('params_file')],
                output='screen',
            ),
            Node(
                package='maasi_drivers',
                executable='guard_node',
                name='guard',
                namespace=robot,
                output='screen',
                respawn=True,
                respawn_delay=0.5,
                condition=IfCondition(LaunchConfiguration('guard')),
            ),
        ]
    )

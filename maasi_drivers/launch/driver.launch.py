"""The driver of one robot, with its guard where it drives on the ground."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node


def generate_launch_description() -> LaunchDescription:
    """Return the nodes of one robot, in its namespace."""
    robot = LaunchConfiguration('robot')
    return LaunchDescription(
        [
            DeclareLaunchArgument('robot', description='Name of the robot: its namespace'),
            DeclareLaunchArgument(
                'executable',
                default_value='turtlebot_driver',
                description='turtlebot_driver, mambo_driver or ranging_driver',
            ),
            DeclareLaunchArgument('params_file', description='Parameters of the driver (YAML)'),
            DeclareLaunchArgument('guard', default_value='true', description='Whether to guard it'),
            LifecycleNode(
                package='maasi_drivers',
                executable=LaunchConfiguration('executable'),
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
                condition=IfCondition(LaunchConfiguration('guard')),
            ),
        ]
    )

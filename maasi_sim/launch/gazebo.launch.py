"""Launch a search in Gazebo: ros2 launch maasi_sim gazebo.launch.py world:=FILE.sdf scenario:=FILE.

Starts `gz sim` with a world that `run_scenario FILE --write-world FILE.sdf` wrote, the bridge with
the file next to it, and the run, with the arguments of scenario.launch.py. Ends with the run.
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    IncludeLaunchDescription,
    OpaqueFunction,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from maasi_sim.scenario.gazebo_world import bridge_file


def start_world(context: LaunchContext) -> list:
    """Return the actions that start simulator and bridge."""
    world = Path(LaunchConfiguration('world').perform(context)).expanduser().resolve()
    show = LaunchConfiguration('gui').perform(context) == 'true'
    bridge = bridge_file(world)
    for file in (world, bridge):
        if not file.is_file():
            raise RuntimeError(
                f'world: {file} is missing; run_scenario FILE --write-world {world} writes it'
            )
    return [
        ExecuteProcess(
            cmd=['gz', 'sim', '-r', *([] if show else ['-s']), str(world)], output='screen'
        ),
        Node(
            package='ros_gz_bridge',
            executable='parameter_bridge',
            name='gazebo_bridge',
            parameters=[{'config_file': str(bridge)}],
            output='screen',
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and what starts simulator, bridge and run."""
    run = Path(__file__).with_name('scenario.launch.py')
    return LaunchDescription(
        [
            DeclareLaunchArgument('world', description='world file (SDF) of run_scenario'),
            DeclareLaunchArgument(
                'gui', default_value='true', description='whether Gazebo is shown; true or false'
            ),
            OpaqueFunction(function=start_world),
            IncludeLaunchDescription(PythonLaunchDescriptionSource(str(run))),
        ]
    )

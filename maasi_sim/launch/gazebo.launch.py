"""Launch a search in Gazebo: ros2 launch maasi_sim gazebo.launch.py world:=FILE.sdf scenario:=FILE.

Starts `gz sim` with a world that `run_scenario FILE --write-world FILE.sdf` wrote, the bridge with
the file next to it, and the run, with the arguments of scenario.launch.py. Ends with the first of
them that ends.
"""

import shutil
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    IncludeLaunchDescription,
    OpaqueFunction,
    Shutdown,
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
    # First, so that nothing starts where it is not installed.
    gazebo = shutil.which('gz')
    if gazebo is None:
        raise RuntimeError('gz: not found in PATH; install Gazebo Harmonic or later')
    return [
        ExecuteProcess(
            cmd=[gazebo, 'sim', '-r', *([] if show else ['-s']), str(world)],
            output='screen',
            on_exit=Shutdown(reason='Gazebo has ended'),
        ),
        Node(
            package='ros_gz_bridge',
            executable='parameter_bridge',
            name='gazebo_bridge',
            parameters=[{'config_file': str(bridge)}],
            output='screen',
            on_exit=Shutdown(reason='the bridge has ended'),
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

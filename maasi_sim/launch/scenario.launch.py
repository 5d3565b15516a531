"""Launch a run of a scenario: ros2 launch maasi_sim scenario.launch.py scenario:=FILE.

It ends with `run_scenario`; exit status: 0 if that exited with 0, else 1, and its code in an error.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, ExecuteProcess, OpaqueFunction
from launch.events import Shutdown
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import ExecutableInPackage

from maasi_sim.run.ending import EXIT_CODES
from maasi_sim.run.run_options import is_true, launch_arguments, scenario_options

# Wall time for stopping the robots and writing the results before it is terminated or killed [s].
PATIENCE = '60'


def end_launch(event: ProcessExited, context: LaunchContext) -> EmitEvent:
    """End the launch; an exception makes its exit status 1."""
    if event.returncode:
        ended = f'ended by signal {-event.returncode}' if event.returncode < 0 else 'unknown'
        meaning = EXIT_CODES.get(event.returncode, ended)
        raise RuntimeError(f'run_scenario exited with {event.returncode}: {meaning}')
    return EmitEvent(event=Shutdown(reason='the run has ended'))


def show(scenario: str, team: str) -> Node:
    """Return RViz with the view of a scenario, for a team in a namespace."""
    from maasi_sim.run.missions import load_mission
    from maasi_sim.run.rviz_view import shown_topics
    from maasi_sim.scenario.loading import config_folder

    three = load_mission(scenario).scenario.dimension == 3
    view = config_folder() / 'rviz' / ('search_3d.rviz' if three else 'search.rviz')
    return Node(
        package='rviz2',
        executable='rviz2',
        arguments=['-d', str(view)],
        parameters=[{'use_sim_time': True}],
        remappings=[(topic, f'/{team}{topic}') for topic in shown_topics(view)] if team else [],
        output='log',
    )


def start_run(context: LaunchContext) -> list:
    """Return the actions that start the run, and RViz if asked for."""
    given = {name: LaunchConfiguration(name).perform(context) for name in launch_arguments()}
    # First, so that nothing starts where it is not installed.
    actions = (
        [show(given['scenario'].strip(), given['namespace'].strip(' /'))]
        if is_true(given, 'rviz')
        else []
    )
    run = ExecuteProcess(
        cmd=[ExecutableInPackage('run_scenario', 'maasi_sim'), *scenario_options(given)],
        output='screen',
        sigterm_timeout=PATIENCE,
        sigkill_timeout=PATIENCE,
        on_exit=end_launch,
    )
    return [*actions, run]


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and what starts the run."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in launch_arguments().items()
            ),
            OpaqueFunction(function=start_run),
        ]
    )

"""Launch the nodes of a scenario: ros2 launch maasi_sim scenario.launch.py scenario:=FILE."""

import tempfile
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    'scenario': ('mambo_turtlebot', 'scenario file, or name of one in maasi_config'),
    'seed': ('', "of all random numbers; empty: the scenario's"),
    'lockstep': ('false', 'step by step, as fast as it goes; true or false'),
    'rate': ('', 'simulated over wall time; empty: 1, in lockstep as fast as it goes'),
    'rviz': ('false', 'whether RViz shows the search; true or false'),
}


def start_nodes(context: LaunchContext) -> list:
    """Return the actions that start the scenario's nodes."""
    from maasi_sim.cuboid_scenario import CuboidScenario, load_any_scenario
    from maasi_sim.linked_robots import with_addresses
    from maasi_sim.node_plan import plan_nodes
    from maasi_sim.scenario import config_folder

    given = {name: LaunchConfiguration(name).perform(context).strip() for name in ARGUMENTS}
    overrides = {}
    if given['seed']:
        overrides['seed:='] = (('seed',), int(given['seed']))
    scenario = load_any_scenario(given['scenario'], overrides)
    if not isinstance(scenario, CuboidScenario):
        scenario = with_addresses(scenario)
    folder = Path(tempfile.mkdtemp(prefix='maasi_'))
    file = folder / 'scenario.yaml'
    file.write_text(scenario.text(), encoding='utf-8')
    plans = plan_nodes(
        scenario,
        seed=scenario.seed,
        lockstep=given['lockstep'].lower() == 'true',
        rate=float(given['rate']) if given['rate'] else None,
        recorder=False,
        file=file,
    )
    actions = []
    for plan in plans:
        parameters = folder / f'{plan.file_name}.yaml'
        parameters.write_text(plan.parameter_text(), encoding='utf-8')
        actions.append(
            Node(
                package=plan.package,
                executable=plan.executable,
                name=plan.name,
                namespace=plan.namespace,
                parameters=[str(parameters)],
                output='screen',
                emulate_tty=True,
                on_exit=[EmitEvent(event=Shutdown(reason=f'{plan.full_name} ended'))]
                if scenario.on_exit == 'end'
                else None,
                respawn=scenario.on_exit == 'respawn',
                respawn_delay=1.0,
            )
        )
    if given['rviz'].lower() == 'true':
        view = 'search_3d.rviz' if scenario.dimension == 3 else 'search.rviz'
        actions.append(
            Node(
                package='rviz2',
                executable='rviz2',
                arguments=['-d', str(config_folder() / 'rviz' / view)],
                output='log',
            )
        )
    return actions


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and what starts the nodes."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=start_nodes),
        ]
    )

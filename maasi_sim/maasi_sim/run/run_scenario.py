"""Run a scenario: its nodes as processes, watched, recorded, and reported on."""

import contextlib
import gc
import os
import sys
from pathlib import Path
from shlex import quote

from maasi_filter.ros import middleware
from maasi_sim.run.ending import DONE, NOT_WRITTEN, WRONG_INPUT, Interruption
from maasi_sim.run.processes import ProcessError, start_server
from maasi_sim.run.run_options import Options, parse


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    interruption = Interruption()
    # ROS has its logs there.
    os.environ.setdefault('HOME', os.path.abspath(os.path.expanduser('~')))
    options = parse(arguments)
    if options.listing:
        return list_scenarios()
    if options.check:
        return check(options)
    if options.write_world is not None:
        return write_world(options, options.write_world)
    if middleware.is_missing():
        return WRONG_INPUT
    # Nodes load what they share while this process loads what is its own.
    try:
        start_server()
    except OSError as error:
        print(f'error: cannot start the node server: {error}', file=sys.stderr)
        return WRONG_INPUT
    gc.disable()
    from maasi_sim.run.bag import BagError, BagWriteError
    from maasi_sim.run.domain import DomainError
    from maasi_sim.run.replay_node import replay
    from maasi_sim.run.run_folder import ResultsError
    from maasi_sim.run.scenario_run import execute
    from maasi_sim.scenario.layering import ScenarioError

    # Modules are never garbage.
    gc.freeze()
    gc.enable()
    try:
        if options.replay is not None and options.scenario:
            from maasi_sim.run.recorded_search import search_recording

            return search_recording(options)
        if options.replay is not None:
            return replay(options.replay, options.out, options.domain_id, interruption)
        return execute(options, interruption)
    except (ScenarioError, DomainError, ProcessError, BagError, ResultsError) as error:
        _print_errors(error)
        return NOT_WRITTEN if isinstance(error, (ResultsError, BagWriteError)) else WRONG_INPUT


def list_scenarios() -> int:
    """Print name and description of each scenario in config, and return the exit code."""
    from maasi_sim.scenario.layering import read_layer
    from maasi_sim.scenario.loading import config_folder

    files = sorted(config_folder().glob('scenarios/*.yaml'))
    width = max(len(file.stem) for file in files)
    for file in files:
        print(f'{file.stem:{width}}  {read_layer(file).data["description"]}')
    return DONE


def check(options: Options) -> int:
    """Check the scenario, print what its search takes, and return the exit code."""
    from maasi_sim.run.missions import checked_mission
    from maasi_sim.run.progress import ProgressDisplay
    from maasi_sim.scenario.layering import ScenarioError

    display = ProgressDisplay(sys.stdout)
    try:
        mission = checked_mission(options, display)
    except ScenarioError as error:
        _print_errors(error)
        return WRONG_INPUT
    display.warn(*mission.warning().splitlines())
    return DONE


def write_world(options: Options, world: Path) -> int:
    """Write the scenario as a world of Gazebo, and return the exit code."""
    from maasi_sim.run.missions import load_mission
    from maasi_sim.run.progress import ProgressDisplay
    from maasi_sim.scenario import gazebo_world
    from maasi_sim.scenario.layering import ScenarioError, print_warnings_plainly
    from maasi_sim.scenario.schema import Scenario

    print_warnings_plainly()
    display = ProgressDisplay(sys.stdout)
    try:
        scenario = load_mission(options.scenario, options.overrides()).scenario
        if not isinstance(scenario, Scenario):
            raise ScenarioError(
                f'{options.scenario}: read a search of buildings; allowed is one for targets'
            )
        notes = gazebo_world.write_world(scenario, world)
    except ScenarioError as error:
        _print_errors(error)
        return WRONG_INPUT
    except OSError as error:
        print(f'error: --write-world: {world}: {error.strerror}', file=sys.stderr)
        return NOT_WRITTEN
    display.warn(*notes)
    display.say(f'{world} and {gazebo_world.bridge_file(world)}: start them by')
    display.say(
        'ros2 launch maasi_sim gazebo.launch.py '
        f'{quote(f"world:={world}")} {quote(f"scenario:={options.scenario}")}'
    )
    return DONE


def _print_errors(error: Exception) -> None:
    with contextlib.suppress(OSError):
        for line in str(error).splitlines():
            print(f'error: {line}', file=sys.stderr)


if __name__ == '__main__':
    sys.exit(main())

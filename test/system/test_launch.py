"""`ros2 launch maasi_sim scenario.launch.py`: does what run_scenario does, and ends with it."""

import importlib.util
import os
import signal
import sys
from pathlib import Path

import pytest
from scenario_runs import reserved_domain, started, write_scenario

from maasi_sim.run.bag import Bag
from maasi_sim.run.processes import find_executable
from maasi_sim.run.run_options import build_parser, launch_arguments, scenario_options

LAUNCH_FILE = Path(__file__).parents[2] / 'maasi_sim' / 'launch' / 'scenario.launch.py'
HAS_LAUNCH = bool(importlib.util.find_spec('launch') and importlib.util.find_spec('launch_ros'))
# As ros2launch does it.
LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource
path, *arguments = sys.argv[1:]
service = LaunchService(argv=arguments)
given = [tuple(item.split(':=', 1)) for item in arguments]
service.include_launch_description(LaunchDescription([
    IncludeLaunchDescription(AnyLaunchDescriptionSource(path), launch_arguments=given)]))
sys.exit(service.run())
"""
# Longer than the address of a socket may be.
TEMPORARY = 'temporary' * 12
DEFAULTS = {name: default for name, (default, _) in launch_arguments().items()}

pytestmark = pytest.mark.system


@pytest.fixture
def launch(tmp_path):
    """Start a launch with arguments, in a free domain, with an empty folder for temporary files."""
    temporary = tmp_path / TEMPORARY
    temporary.mkdir()

    def start(**given):
        arguments = {name: str(value) for name, value in given.items()}
        if HAS_LAUNCH:
            given = [f'{name}:={value}' for name, value in arguments.items()]
            command = [sys.executable, '-c', LAUNCH, str(LAUNCH_FILE), *given]
        else:
            # The process that the launch file starts.
            options = scenario_options({**DEFAULTS, **arguments})[:-1]
            executable = str(find_executable('maasi_sim', 'run_scenario'))
            command = [executable, *options, f'--domain-id={domain.number}']
        environment = {'ROS_DOMAIN_ID': str(domain.number), 'TMPDIR': str(temporary)}
        folder = tmp_path / 'run'
        return started(command, folder, environment, cwd=tmp_path, start_new_session=True)

    with reserved_domain() as domain:
        yield start


def code(run_code):
    """Return the exit status of a launch for the exit code of run_scenario."""
    return int(run_code != 0) if HAS_LAUNCH else run_code


def test_a_launch_records_reports_and_ends_with_the_run(launch, tmp_path):
    run = launch(
        scenario=write_scenario(tmp_path / 'one.yaml', [[1.9, 1.9]]),
        out=tmp_path / 'run',
        seed=7,
        lockstep='true',
        planner='lawnmower',
        log_level='warn',
    ).finish()
    assert run.code == 0, run.output
    assert (run.report['end_reason'], run.report['seed']) == ('all_found', 7)
    with Bag(run.folder) as bag:
        assert bag.counts['/found_targets'] > 0
        assert bag.scenario()['nodes']['/planner_node']['parameters']['planner.name'] == 'lawnmower'
    assert '[INFO]' not in (run.folder / 'filter_node.log').read_text()
    assert list((tmp_path / TEMPORARY).iterdir()) == []


def test_an_interrupted_launch_leaves_no_process_and_a_readable_recording(launch, tmp_path):
    path = write_scenario(tmp_path / 'far.yaml', [[0.0, 0.0]])
    run = launch(scenario=path, out=tmp_path / 'run', rate='1.0')
    run.wait_for('measurements')
    os.killpg(run.process.pid, signal.SIGINT)
    assert run.finish().code == code(130), run.output
    assert run.report['end_reason'] == 'interrupted'
    assert 'Traceback' not in run.output
    assert run.processes() == []
    with Bag(run.folder) as bag:
        assert bag.scenario()['name'] == 'far'
        assert bag.counts['/mambo/state'] > 0


def test_a_wrong_argument_ends_the_launch_with_one_clear_error(launch):
    run = launch(seed='abc').finish()
    assert run.code == code(2), run.output
    assert "read 'abc', allowed are whole numbers from 0" in run.output
    assert 'Traceback' not in run.output
    for name in ('lockstep', 'record', 'rviz', 'view'):
        with pytest.raises(ValueError, match=f"{name}: read 'maybe', allowed are true and false"):
            scenario_options({**DEFAULTS, name: 'maybe'})


def test_arguments_become_options_that_run_scenario_knows(monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    given = {'out': '-folder', 'seed': '3', 'lockstep': 'True', 'record': 'false', 'rate': '2'}
    given |= {'planner': 'maasi', 'time_limit': '9', 'log_level': 'debug', 'namespace': 'team_a'}
    others = {'view': 'true', 'port': '8500'}
    first, second = (
        vars(build_parser().parse_args(scenario_options(DEFAULTS | item)))
        for item in (given, others)
    )
    expected = given | {'scenario': 'mambo_turtlebot', 'out': Path('-folder'), 'seed': 3}
    expected |= {'lockstep': True, 'record': False, 'rate': 2.0, 'time_limit': 9.0}
    expected |= {'domain_id': 7, 'view': False, 'port': None}
    assert expected.items() <= first.items()
    assert {'view': True, 'port': 8500}.items() <= second.items()

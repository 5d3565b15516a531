"""`ros2 launch maasi_sim scenario.launch.py`: does what run_scenario does, and ends with it.

Where `launch` is not installed, the process that the launch file starts is run by itself.
"""

import importlib.util
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from reserved_domain import reserved_domain
from scenario_runs import PATIENCE, processes_with

from maasi_sim.run.bag import Bag
from maasi_sim.run.launch_arguments import ARGUMENTS, scenario_options
from maasi_sim.run.processes import find_executable
from maasi_sim.run.run_options import build_parser

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
DEFAULTS = {name: default for name, (default, _) in ARGUMENTS.items()}

pytestmark = pytest.mark.system


@pytest.fixture
def launch(tmp_path):
    """Start a launch with arguments, in a free domain, with an empty folder for temporary files."""
    temporary = tmp_path / TEMPORARY
    temporary.mkdir()

    def start(**arguments):
        environment = {**os.environ, 'ROS_DOMAIN_ID': number, 'TMPDIR': str(temporary)}
        if HAS_LAUNCH:
            given = [f'{name}:={value}' for name, value in arguments.items()]
            command = [sys.executable, '-c', LAUNCH, str(LAUNCH_FILE), *given]
        else:
            options = scenario_options({**DEFAULTS, **arguments})[:-1]
            executable = str(find_executable('maasi_sim', 'run_scenario'))
            command = [executable, *options, f'--domain-id={number}']
        return subprocess.Popen(
            command,
            cwd=tmp_path,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    with reserved_domain() as domain:
        number = str(domain.number)
        yield start


def code(run_code):
    """Return the exit status of a launch for the exit code of run_scenario."""
    return int(run_code != 0) if HAS_LAUNCH else run_code


def scenario(path, **changes):
    content = {
        'version': 1,
        'environment': {'bounds': [[-0.3, 2.4], [-0.3, 2.4]]},
        'targets': {'positions': [[1.9, 1.9]]},
        'robots': {
            'mambo': {
                'type': 'mambo',
                'start': [1.9, 1.9, 1.0],
                'candidates': {'grid': [7, 7], 'spacing': 0.384, 'corner': [-0.1, -0.1]},
            }
        },
        'filter': {'method': 'pmb'},
        'limits': {'time': 60.0},
        **changes,
    }
    path.write_text(yaml.safe_dump(content))
    return str(path)


def test_a_launch_records_reports_and_ends_with_the_run(launch, tmp_path):
    process = launch(
        scenario=scenario(tmp_path / 'one.yaml'),
        out=str(tmp_path / 'run'),
        seed='7',
        lockstep='true',
        planner='lawnmower',
        log_level='warn',
    )
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, output
    report = json.loads((tmp_path / 'run' / 'report.json').read_text())
    assert report['end_reason'] == 'all_found' and report['seed'] == 7
    with Bag(tmp_path / 'run') as bag:
        assert bag.counts['/found_targets'] > 0
        assert bag.scenario()['nodes']['/planner_node']['parameters']['planner.name'] == 'lawnmower'
    assert '[INFO]' not in (tmp_path / 'run' / 'filter_node.log').read_text()
    assert list((tmp_path / TEMPORARY).iterdir()) == []


def test_an_interrupted_launch_ends_the_run(launch, tmp_path):
    folder = tmp_path / 'run'
    path = scenario(tmp_path / 'far.yaml', targets={'positions': [[0.0, 0.0]]})
    process = launch(scenario=path, out=str(folder), record='false', rate='1.0')
    for line in process.stdout:
        if 'measurements' in line:
            break
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == code(130), output
    assert json.loads((folder / 'report.json').read_text())['end_reason'] == 'interrupted'
    assert not (folder / 'bag').exists()
    assert processes_with(str(folder)) == []


def test_a_wrong_argument_ends_the_launch_with_one_clear_error(launch):
    process = launch(seed='abc')
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == code(2), output
    assert "read 'abc', allowed are whole numbers from 0" in output
    assert 'Traceback' not in output
    for name in ('lockstep', 'record', 'rviz', 'view', 'follow_clock'):
        with pytest.raises(ValueError, match=f"{name}: read 'maybe', allowed are true and false"):
            scenario_options({**DEFAULTS, name: 'maybe'})


def test_arguments_become_options_that_run_scenario_knows(monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    given = {
        'out': '-folder',
        'seed': '3',
        'lockstep': 'True',
        'record': 'false',
        'rate': '2',
        'planner': 'maasi',
        'time_limit': '9',
        'log_level': 'debug',
        'namespace': 'team_a',
    }
    others = {'follow_clock': 'true', 'view': 'true', 'port': '8500'}
    read = [
        vars(build_parser().parse_args(scenario_options(DEFAULTS | item)))
        for item in (given, others)
    ]
    expected = given | {'scenario': 'mambo_turtlebot', 'out': Path('-folder'), 'seed': 3}
    expected |= {'lockstep': True, 'no_record': True, 'rate': 2.0, 'time_limit': 9.0}
    del expected['record']
    expected |= {'domain_id': 7, 'follow_clock': False, 'view': False, 'port': None}
    assert {key: read[0][key] for key in expected} == expected
    assert [read[1][key] for key in ('follow_clock', 'view', 'port')] == [True, True, 8500]

"""The examples: each is run, as a user would."""

import json
import re
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from scenario_runs import PATIENCE, alongside, run_scenario

from maasi_drivers.settings.driver import DriverSettings, GuardSettings
from maasi_filter import plugins
from maasi_filter.ros.node_parameters import check
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import flatten
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_sim.run.bag import Bag
from maasi_sim.run.run_options import Options
from maasi_sim.run.targets.mission import TargetMission
from maasi_sim.scenario import load_scenario
from maasi_sim.search import search

EXAMPLES = Path(__file__).resolve().parents[1] / 'examples'


def run_python(*arguments):
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)


@pytest.fixture(autouse=True)
def imports(monkeypatch):
    """Undo what is imported from the folders of examples."""
    monkeypatch.setattr(sys, 'path', list(sys.path))
    monkeypatch.setattr(plugins, '_folders', [])
    yield
    for name, module in list(sys.modules.items()):
        if str(EXAMPLES) in str(getattr(module, '__file__', '')):
            del sys.modules[name]


def test_the_notebook_is_stored_with_outputs_in_which_the_default_planner_wins(monkeypatch, capsys):
    matplotlib.use('Agg')
    monkeypatch.chdir(EXAMPLES)
    notebook = json.loads((EXAMPLES / 'search.ipynb').read_text())
    names: dict[str, object] = {}
    stored = ''
    for cell in notebook['cells']:
        if cell['cell_type'] == 'code':
            assert cell['outputs'], 'call ./scripts/python docs/site/notebook.py'
            stored += ''.join(''.join(output.get('text', '')) for output in cell['outputs'])
            exec(''.join(cell['source']), names)
    for text in (stored, capsys.readouterr().out):
        assert text.startswith('all_found')
        lows = re.findall(r'default saves \d+ \[(\d+), \d+\] measurements', text)
        assert len(lows) == 2 and min(map(int, lows)) > 0


@pytest.mark.parametrize(('kind', 'method'), [('Cone', 'ic_phd'), ('CompiledCone', 'pmb')])
def test_a_robot_with_a_sensor_of_its_own_finds_targets(kind, method):
    changes = {
        'sensor': (('robots', 'scout', 'sensor', 'detection', 'kind'), f'cone_sensor:{kind}'),
        'filter': (('filter',), {'method': method, 'found_radius': 0.15, 'jitter_deviation': 0.03}),
    }
    if method == 'ic_phd':
        changes['filter'][1]['removal_distance'] = 0.3
    result = search(load_scenario(EXAMPLES / 'own_sensor' / 'search.yaml', changes), seed=1)
    assert result.missed == 0, result.end_reason
    assert result.rmse < 0.1


@pytest.mark.parametrize('seed', [1, 2])
def test_a_filter_of_ones_own_finds_targets(seed):
    result = search(load_scenario(EXAMPLES / 'own_filter' / 'search.yaml'), seed)
    assert (result.missed, result.false_found) == (0, 0), result.end_reason
    assert result.rmse < 0.1


OWN = ('planner', 'filter', 'sensor')


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """Return a run with a planner, a filter and a sensor of one's own."""
    folder = tmp_path_factory.mktemp('examples')
    content = yaml.safe_load((EXAMPLES / 'own_sensor' / 'search.yaml').read_text())
    content['plugin_path'] = [str(EXAMPLES / f'own_{part}') for part in OWN]
    content['filter'] = {'method': 'hit_counter:HitCounter', 'settings': {'gate': 0.4}}
    content['planner'] = {'name': 'random_planner:RandomPlanner', 'settings': {'seed': 5}}
    content['limits'] = {'time': 12.0}
    (folder / 'robots').symlink_to(EXAMPLES / 'robots')
    done = run_scenario(content, folder / 'out', '--lockstep')
    assert done.code in (0, 1), done.output
    return done


def test_nodes_run_the_own_classes_as_one_process_does(run):
    result = search(load_scenario(run.folder.parent / 'search.yaml'), seed=1)
    assert result.total_measurements > 20 and run.report['measurements'] == result.measurements
    found = [item['position'] for item in run.report['found']]
    assert np.allclose(found, [item.position for item in result.found_targets], atol=1e-6)


def test_a_recording_is_read_as_the_document_says(run, capsys):
    text = (EXAMPLES.parent / 'docs' / 'how_to' / 'bags.md').read_text()
    (block,) = re.findall(r'```python\n(.*?)```', text, re.DOTALL)
    exec(block.replace('runs/20260101_120000/bag', str(run.bag)), {})
    targets = len(run.report['found'])
    assert capsys.readouterr().out.splitlines()[-1].count('(') == targets > 0


def test_a_recording_is_read_without_our_packages(run):
    # Isolated: neither PYTHONPATH nor the current folder.
    done = run_python('-I', EXAMPLES / 'read_bag' / 'read_bag.py', run.bag)
    assert done.returncode == 0, done.stderr
    with Bag(run.folder) as bag:
        stamps = [item.message.header.stamp for item in bag.messages(['/scout/state'])]
    first = stamps[0].sec + 1e-9 * stamps[0].nanosec
    assert f'/scout/state: {len(stamps)} poses, from {first:.1f} to' in done.stdout
    assert done.stdout.count('target ') == len(run.report['found'])


def test_detections_of_ones_own_are_found_without_a_warning(domain):
    folder = EXAMPLES / 'own_detections'
    parameters = ['--ros-args', '--params-file', str(folder / 'filter.yaml')]
    node = subprocess.Popen(
        ['filter_node', *parameters], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        done = run_python(folder / 'own_detections.py')
    finally:
        node.terminate()
        log, _ = node.communicate(timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    # Fast DDS may complain there of the ports of processes that were killed.
    match = re.search(r'found a target at \((.*), (.*)\) m after', done.stdout)
    assert match and np.allclose([float(part) for part in match.groups()], [3.0, 2.0], atol=0.1)
    assert 'late detections' not in log and 'allowed is' not in log, log


def test_the_team_of_the_field_finds_its_targets_in_simulation():
    result = search(load_scenario(EXAMPLES / 'field_team' / 'search.yaml'), 1)
    assert result.missed == 0 and result.false_found == 0


# Of each node: executable, settings, and what differs from the simulation; the rest is the same.
DIFFER = {'battery_minimum', 'image_transport'}
OF_THE_FIELD = {
    'turtlebot_driver': ('turtlebot_driver', DriverSettings, DIFFER | {'tf_rate'}),
    'turtlebot_guard': ('guard_node', GuardSettings, set()),
    'drone_driver': ('mavlink_camera_driver', DriverSettings, DIFFER | {'link'}),
    'filter_node': ('filter_node', FilterNodeSettings, set()),
    'planner_node': ('planner_node', PlannerNodeSettings, set()),
}


def test_the_parameters_of_the_field_are_those_of_its_simulation():
    folder = EXAMPLES / 'field_team'
    file = folder / 'search.yaml'
    plans = {
        '_'.join(filter(None, (plan.namespace, plan.name))): plan
        for plan in TargetMission('search', load_scenario(file)).plan_nodes(Options(), file)
    }
    for node, (_, model, allowed) in OF_THE_FIELD.items():
        parameters = yaml.safe_load((folder / f'{node}.yaml').read_text())['/**']['ros__parameters']
        settings, problems = check(model, parameters)
        assert problems == {}, node
        simulated = dict(plans[node].parameters)
        del simulated['use_sim_time']
        there = flatten(check(model, simulated)[0].resolved())
        here = flatten(settings.resolved())
        # Of the autopilot the simulation knows nothing.
        different = {key for key in here if here[key] != there.get(key)}
        assert {key for key in different if not key.startswith('mavlink.')} == allowed, node
        if 'mavlink.own_system' in parameters:
            lines = (folder / 'arducopter.parm').read_text().splitlines()
            autopilot = dict(line.split() for line in lines if not line.startswith('#'))
            assert int(autopilot['MAV_GCS_SYSID']) == parameters['mavlink.own_system']


def test_the_nodes_of_the_field_become_active_with_their_file(tmp_path):
    latest, processes, names = {}, [], set()

    def on_diagnostics(message):
        latest.update({item.name: item.message for item in message.status})

    def active():
        assert all(process.poll() is None for process in processes)
        return all(latest.get(name, '').startswith('active') for name in names)

    with alongside() as operator, ExitStack() as started:
        operator.node.create_subscription(DiagnosticArray, '/diagnostics', on_diagnostics, 50)
        for file, (executable, *_) in OF_THE_FIELD.items():
            robot = file.partition('_')[0] if file.endswith(('_driver', '_guard')) else ''
            names.add('/' + file.replace(f'{robot}_', f'{robot}/') if robot else f'/{file}')
            words = ['--ros-args', '-r', f'__ns:=/{robot}', '--params-file', f'{file}.yaml']
            log = started.enter_context((tmp_path / file).open('w'))
            process = subprocess.Popen(
                [executable, *words], cwd=EXAMPLES / 'field_team', stdout=log, stderr=log
            )
            processes.append(process)
            started.callback(process.wait, PATIENCE)
            started.callback(process.terminate)
        operator.until(active, lambda: latest)

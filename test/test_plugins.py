"""Classes of a user's own: by entry point, by module:Class, with settings of their own."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from test_code_blocks import BLOCKS

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter import AgentMeasurement, FilterSettings, Pose, load_filter, make_filter, plugins
from maasi_filter.plugins import PluginError
from maasi_filter.ros.parameters import flatten, parameter_fields, unflatten
from maasi_filter.settings import unused_settings
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planners import Planner, make_planner
from maasi_planner.settings import PLANNERS, planner_settings
from maasi_sim.run.run_options import Options
from maasi_sim.run.targets.mission import TargetMission
from maasi_sim.scenario import ScenarioError, load_scenario
from maasi_sim.search import search

ONE_BY_ONE = '''
from pydantic import BaseModel, ConfigDict, Field

from maasi_planner.planners.base import Planner
from maasi_planner.planners.options import options_of, waiting_places
from maasi_planner.team import Decision, single_choice, stay


class OneByOne(Planner):
    """Goes from candidate to candidate."""

    class Settings(BaseModel):
        model_config = ConfigDict(extra='forbid')
        stride: int = Field(default=1, ge=1)

    def decide(self, team):
        decision = Decision(team.step)
        for name in team.planning():
            option = options_of(team, name, waiting_places(team))
            if isinstance(option, str):
                decision.robots[name] = stay(team.robots[name], option)
                continue
            chosen = self.own.stride % len(option.points)
            while not option.allowed[chosen]:
                chosen = (chosen + 1) % len(option.points)
            decision.robots[name] = single_choice(option.points, option.prediction, chosen, 'next')
        return decision
'''
SCENARIO = """
version: 1
environment: {bounds: [[0.0, 2.0], [0.0, 2.0]]}
step: 0.1
targets: {positions: [[1.5, 0.5]]}
robots:
  rover:
    type: scout
    start: [1.0, 1.0, 0.0]
    candidates: {grid: [2, 2], spacing: 1.0}
filter: {method: pmb}
planner:
  name: one_by_one:OneByOne
  settings: {stride: 3}
limits: {time: 5.0}
"""
ROBOTS = Path(__file__).resolve().parents[1] / 'examples' / 'robots'


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with a scenario and a planner next to it; imports are undone."""
    monkeypatch.setattr(sys, 'path', list(sys.path))
    monkeypatch.setattr(plugins, '_folders', [])
    known = set(sys.modules)
    (tmp_path / 'one_by_one.py').write_text(ONE_BY_ONE)
    (tmp_path / 'search.yaml').write_text(SCENARIO)
    (tmp_path / 'robots').symlink_to(ROBOTS)
    yield tmp_path
    for name in set(sys.modules) - known:
        if str(tmp_path) in str(getattr(sys.modules[name], '__file__', '')):
            del sys.modules[name]


def change(folder: Path, before: str, after: str) -> Path:
    path = folder / 'search.yaml'
    assert before in path.read_text()
    path.write_text(path.read_text().replace(before, after))
    return path


def chosen(result) -> list[int]:
    return [decision.robots['rover'].chosen for decision in result.decisions]


def test_planner_beside_the_scenario(folder, tmp_path_factory):
    scenario = load_scenario(folder / 'search.yaml')
    assert scenario.planner.settings.stride == 3
    assert chosen(search(scenario, 1, most_measurements=2)) == [3]
    # Its text names the folder, for a copy elsewhere.
    copy = tmp_path_factory.mktemp('run') / 'scenario.yaml'
    copy.write_text(scenario.text())
    assert load_scenario(copy).plugin_path[0] == str(folder)
    assert load_scenario(copy).planner.settings.stride == 3
    # Another one instead of it: by name, and as a class.
    (folder / 'second.py').write_text(ONE_BY_ONE.replace('OneByOne', 'Second'))
    for planner, why in (('lawnmower', 'lane'), ('second:Second', 'next')):
        other = search(scenario, 1, most_measurements=5, planner=planner)
        assert why in other.decisions[0].robots['rover'].reason
    assert search(scenario, 1, most_measurements=5, planner=sys.modules['second'].Second).decisions
    with pytest.raises(ValueError, match=r"^planner: unknown planner 'third'"):
        search(scenario, 1, planner='third')


def test_installed_planner(folder):
    # An entry point in a dist-info folder on the path is one of an installed package.
    info = folder / 'walks-1.0.dist-info'
    info.mkdir()
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: walks\nVersion: 1.0\n')
    (info / 'entry_points.txt').write_text(
        '[maasi.planners]\nwalk = one_by_one:OneByOne\nbroken = no_such_module:Walk\n'
    )
    sys.path.insert(0, str(folder))
    assert {'walk', 'maasi'} <= set(PLANNERS.names())
    scenario = load_scenario(change(folder, 'one_by_one:OneByOne', 'walk'))
    assert (scenario.planner.settings.stride, scenario.plugin_path) == (3, [])
    assert isinstance(make_planner('walk', scenario.planner), Planner)
    for name, message in (
        ('broken', "planner 'broken': there is no module no_such_module"),
        ('wolk', r"unknown planner 'wolk' \(did you mean 'walk'\?\), .*maas"),
    ):
        with pytest.raises(ValueError, match=message):
            make_planner(name)


@pytest.mark.parametrize(
    ('file', 'name', 'message'),
    [
        ('', 'nowhere:Planner', r'there is no module nowhere: .*{folder}'),
        ('import nowhere_too', 'mine:A', r"No module named 'nowhere_too' \({folder}/mine.py:1\)"),
        ('a = 1\nb = a / 0', 'mine:A', r'ZeroDivisionError: .*\({folder}/mine.py:2\)'),
        ('a = (', 'mine:A', r'SyntaxError: .*\({folder}/mine.py:1\)'),
        ('raise SystemExit(3)', 'mine:A', 'mine cannot be imported: SystemExit'),
        ('class B:\n    pass', 'mine:A', 'module mine has no A, its classes are B'),
        ('class A:\n    pass', 'mine:A', 'subclass of maasi_planner.planners.base.Planner'),
        (
            'from maasi_planner.planners import Planner\nclass A(Planner):\n    pass',
            'mine:A',
            'mine:A lacks decide of',
        ),
    ],
)
def test_bad_plugin_is_named(folder, file, name, message):
    (folder / 'mine.py').write_text(file)
    path = change(folder, 'one_by_one:OneByOne', name)
    with pytest.raises(ScenarioError, match=message.format(folder=folder)) as error:
        load_scenario(path)
    assert str(error.value).startswith(f'{path}:13: planner.name: ')


@pytest.mark.parametrize(
    ('before', 'after', 'message'),
    [
        ('stride: 3', 'stride: 0', 'stride: read 0, allowed is greater than or equal to 1'),
        ('stride: 3', "stride: '3'", "stride: read '3', allowed is a whole number"),
        ('stride: 3', 'strid: 3', "strid: unknown key 'strid' .*known are stride"),
        ('one_by_one:OneByOne', 'lawnmower', "planner 'lawnmower' has no settings"),
    ],
)
def test_bad_settings_have_file_and_line(folder, before, after, message):
    path = change(folder, before, after)
    with pytest.raises(ScenarioError, match=message) as error:
        load_scenario(path)
    assert str(error.value).startswith(f'{path}:14: planner.settings')


def test_two_modules_of_one_name_are_refused(folder, tmp_path_factory):
    load_scenario(folder / 'search.yaml')
    other = shutil.copytree(folder, tmp_path_factory.mktemp('other') / 'copy')
    with pytest.raises(ScenarioError, match='give it another name'):
        load_scenario(other / 'search.yaml')


def test_the_command_line_replaces_a_planner_with_its_settings(folder):
    changes = {'--planner': (('planner', 'name'), 'maasi')}
    assert load_scenario(folder / 'search.yaml', changes).planner.settings is None
    path = change(folder, '  settings: {stride: 3}\n', '')
    change(folder, 'one_by_one:OneByOne', 'maasi')
    changes = {'--planner': (('planner', 'name'), 'one_by_one:OneByOne')}
    assert load_scenario(path, changes).plugin_path[0] == str(folder)


def test_parameters_of_a_plugin(folder):
    plugins.add_folders([folder])
    given = {
        'environment.bounds': [0.0, 1.0, 0.0, 1.0],
        'robots': ['a'],
        'robot.a.candidates.ring': 4,
        'robot.a.candidates.distance': 1.0,
        'planner.name': 'one_by_one:OneByOne',
        'planner.settings.stride': 2,
    }
    fields = {item.name: item for item in parameter_fields(PlannerNodeSettings, given)}
    assert fields['planner.settings.stride'].bound('ge') == 1
    settings = PlannerNodeSettings.model_validate(unflatten(PlannerNodeSettings, given))
    assert settings.planner.settings.stride == 2
    assert flatten(settings)['planner.settings.stride'] == 2
    with pytest.raises(PluginError):
        PLANNERS.load('one_by_one:Nothing')
    assert planner_settings(name='one_by_one:OneByOne').settings.stride == 1


def test_filter_of_ones_own(folder):
    shutil.copy(ROBOTS.parent / 'own_filter' / 'hit_counter.py', folder / 'hit_counter.py')
    change(folder, '{method: pmb}', '{method: hit_counter:HitCounter, settings: {gate: 0.3}}')
    scenario = load_scenario(folder / 'search.yaml')
    assert (scenario.filter.settings.gate, scenario.filter.settings.hits) == (0.3, 4.0)
    plans = TargetMission('search', scenario).plan_nodes(Options(), folder / 'search.yaml')
    (parameters,) = [plan.parameters for plan in plans if plan.name == 'filter_node']
    assert parameters['filter.settings.gate'] == 0.3
    # A saved one continues as the one that was saved.
    target, sensor = np.array([[1.2, 1.5]]), scenario.robots['rover'].sensor.build('rover', 2)
    pose, generator = Pose.from_yaw([1.0, 1.0, 0.0], 0.0), np.random.default_rng(1)
    filters = [make_filter(scenario.filter, scenario.environment.array(), generator)]
    for step in range(4):
        values = sensor.measurement.measure(target, pose)
        measured = [AgentMeasurement('rover', pose, sensor, values, index=step)]
        results = [item.step(measured, 1, float(step)) for item in filters]
        assert len({repr(result) for result in results}) == 1
        filters[-1].save(folder / 'state')
        filters.append(load_filter(folder / 'state'))
    (found,) = filters[-1].found_targets
    np.testing.assert_allclose(found.position, target[0], atol=1e-9)
    # Another one has not its settings.
    pmb = load_scenario(folder / 'search.yaml', {'--filter': (('filter', 'method'), 'pmb')})
    assert pmb.filter.settings is None
    with pytest.raises(ValueError, match=r"filter 'pmb'"):
        FilterSettings(method='pmb', settings={'gate': 0.3})
    # What only the others use, and what is not its own.
    other = FilterSettings(method='hit_counter:HitCounter', births='uniform', pmb={'walk': 0.1})
    for line, start in zip(
        unused_settings(other).splitlines(),
        ('births: only for method ic_phd', 'pmb: '),
        strict=True,
    ):
        assert line.startswith(f'filter: {start}')
    for key, value, message in (
        ('settings', {'gate': -1.0}, r'filter\.settings\.gate: read -1'),
        ('method', 'pbm', r"unknown filter 'pbm' \(did you mean 'pmb'\?\), known are ic_phd, pmb"),
        ('method', 'hit_counter:Candidate', r'subclass of maasi_filter\.search_filter'),
    ):
        with pytest.raises(ScenarioError, match=message):
            load_scenario(folder / 'search.yaml', {key: (('filter', key), value)})


def documented(name):
    """Return the code of a class in the documents."""
    return next(block.text for block in BLOCKS if f'class {name}(' in block.text)


GAINED = """
from pydantic import BaseModel, Field


class Gained(Cart):
    class Settings(BaseModel):
        gain: float = Field(default=1.0, gt=0.0)

    def command(self, state, waypoint):
        return self.settings.settings.gain * super().command(state, waypoint)
"""


def test_motion_model_of_ones_own(folder):
    (folder / 'cart.py').write_text(documented('Cart') + GAINED)
    changes = {
        'model': (('robots', 'rover', 'motion', 'model'), 'cart:Gained'),
        'gain': (('robots', 'rover', 'motion', 'settings'), {'gain': 2.0}),
    }
    scenario = load_scenario(folder / 'search.yaml', changes)
    result = search(scenario, 1)
    assert result.distance['rover'] > 0.1
    assert result.decisions[0].robots['rover'].lengths.max() > 10
    changes['gain'] = (('robots', 'rover', 'motion', 'settings'), {'gain': -2.0})
    with pytest.raises(ScenarioError, match=r'motion\.settings\.gain: read -2'):
        load_scenario(folder / 'search.yaml', changes)


def test_detector_of_ones_own(folder):
    (folder / 'bright.py').write_text(documented('Brightest'))
    plugins.add_folders([folder])
    settings = CameraSettings.model_validate({'segmentation': {'rule': 'bright:Brightest'}})
    image = np.zeros((120, 160, 3), np.uint8)
    image[40, 100] = 255
    seen = MarkerDetector(settings).detect(image, Pose.from_yaw([1.0, 1.0, 1.0], 0.0))
    assert len(seen.positions) == 1
    # The camera looks down from 1 m, the image's top to the front (260 px focal length).
    assert seen.positions[0] == pytest.approx([1.0 + 19.5 / 260, 1.0 - 20.5 / 260], abs=1e-6)


@pytest.mark.parametrize(
    ('returned', 'message'),
    [
        ({'reach': '2.0'}, 'lacks compiled or evaluate'),
        ({'reach': '0.0'}, 'reach: got 0.0, allowed are finite numbers above 0'),
        ({'reach': "'far'"}, "reach: got 'far', allowed are numbers"),
        ({'evaluate': 'x'}, r'got a probability of -1.0, allowed are numbers in \[0, 1\]'),
        ({'evaluate': '0.5'}, r'evaluate: got shape \(\), allowed is \(263169,\)'),
        ({'evaluate': "'never'"}, "evaluate: got 'never', allowed are numbers"),
        ({'compiled': "'often'"}, r"compiled: got \['often', .*, allowed are numbers"),
        ({'compiled': '1.0 + x * x'}, 'got a probability of 1.'),
        (
            {'values': '[[1.0], []]', 'compiled': '0.5'},
            r'values: got \[\[1.0\], \[\]\], allowed are numbers',
        ),
    ],
)
def test_wrong_detection_models_are_refused_before_anything_starts(folder, returned, message):
    arguments = {'evaluate': 'self, x, y, z', 'compiled': 'x, y, z, values'}
    methods = ''.join(
        f'    def {name}({arguments.get(name, "self")}): return {value}\n'
        for name, value in {'reach': '1.0', **returned}.items()
    )
    (folder / 'mine.py').write_text(
        'from maasi_filter.models.own_detection import OwnDetection\n'
        f'class Mine(OwnDetection):\n{methods}'
    )
    changes = {'kind': (('robots', 'rover', 'sensor', 'detection', 'kind'), 'mine:Mine')}
    with pytest.raises(ScenarioError, match=message) as error:
        load_scenario(folder / 'search.yaml', changes)
    assert 'mine:Mine' in str(error.value)


@pytest.mark.parametrize(
    ('spoil', 'message'),
    [
        ('return None', 'decide returned None, allowed is a Decision'),
        ('return {}', 'decide returned {}, allowed is a Decision'),
        ('decision.robots.clear()', r"decided for \[\], .* the robots that plan, \['rover'\]"),
        ("decision.robots['rover'] = None", 'rover: got None, allowed is a RobotDecision'),
        (
            'rover.waypoint = np.array([81.0, 0.0, 0.0])',
            r'rover: waypoint: got \[81.0, 0.0, 0.0\], allowed is inside \[\[0.0, 2.0\]',
        ),
        ('rover.waypoint[0] = np.nan', 'rover: waypoint: got a number that is not finite'),
        ('rover.waypoint = [1.0, 1.0, 0.0]', r'rover: waypoint: got \[1.0, 1.0, 0.0\], allowed is'),
        ('rover.yaws = rover.yaws[1:]', r'rover: yaws: got shape \('),
        ('rover.chosen = 4', r'rover: chosen: got 4, allowed are -1 \(stay\) to 3'),
    ],
)
def test_wrong_decisions_are_refused(folder, spoil, message):
    spoilt = ONE_BY_ONE.replace(
        'return decision',
        f"rover = decision.robots['rover']\n        {spoil}\n        return decision",
    )
    (folder / 'one_by_one.py').write_text(f'import numpy as np\n{spoilt}')
    scenario = load_scenario(folder / 'search.yaml')
    with pytest.raises(PluginError, match=f'^planner one_by_one:OneByOne: {message}'):
        search(scenario, 1)


def test_driver_of_ones_own_is_tried_before_anything_starts(folder):
    (folder / 'mine.py').write_text('import nowhere_too\n')
    changes = {'driver': (('robots', 'rover', 'driver'), 'mine:Driver')}
    scenario = load_scenario(folder / 'search.yaml', changes)
    run = Options(lockstep=True), folder / 'search.yaml'
    mission = TargetMission('search', scenario)
    with pytest.raises(ScenarioError, match=r"robots\.rover\.driver: .*'nowhere_too'"):
        mission.plan_nodes(*run)
    (folder / 'mine.py').write_text(
        'from maasi_drivers.drivers import RangingDriver\nclass Driver(RangingDriver):\n    pass\n'
    )
    (plan,) = [plan for plan in mission.plan_nodes(*run) if plan.role == 'driver']
    assert plan.process(folder).command[1:3] == ['mine:Driver', str(folder)]
    with pytest.raises(ScenarioError, match=r"unknown driver 'mambo_drive' .*mean 'mambo_d"):
        load_scenario(folder / 'search.yaml', {'d': (('robots', 'rover', 'driver'), 'mambo_drive')})

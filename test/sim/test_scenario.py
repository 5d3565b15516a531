"""Scenario files: layers, and messages for what is wrong in them."""

import re
import warnings
from copy import deepcopy
from pathlib import Path

import pytest
import yaml

from maasi_sim.run.missions import load_mission
from maasi_sim.scenario.checks import never_seen, robot_candidates
from maasi_sim.scenario.layering import ScenarioWarning
from maasi_sim.scenario.loading import (
    config_folder,
    find_scenario,
    load_scenario,
    scenario_from_values,
)
from maasi_sim.scenario.schema import ScenarioError

# Those of buildings are of another kind: test_cuboid_scenario.py.
SCENARIOS = sorted(
    path
    for path in (config_folder() / 'scenarios').glob('*.yaml')
    if 'cuboid_mpc' not in path.read_text()
)

PLAIN = {
    'version': 1,
    'environment': {'bounds': [[0.0, 2.0], [0.0, 2.0]]},
    'step': 0.05,
    'targets': {'count': 3, 'separation': 0.1, 'margin': 0.1},
    'robots': {
        'mambo': {
            'type': 'mambo',
            'start': [0.5, 0.5, 1.0],
            'candidates': {'grid': [6, 6], 'spacing': 0.34, 'corner': [0.15, 0.15]},
        }
    },
}


def changed(*changes, content=PLAIN):
    """Return a scenario with values put in (or taken out: None) at dotted keys."""
    content = deepcopy(content)
    for key, value in changes:
        inner = content
        *above, last = [int(step) if step.isdigit() else step for step in key.split('.')]
        for step in above:
            inner = inner[step] if isinstance(inner, list) else inner.setdefault(step, {})
        if value is None:
            del inner[last]
        else:
            inner[last] = value
    return content


@pytest.fixture
def load(tmp_path):
    def write_and_load(content, overrides=None):
        path = tmp_path / 'my_scenario.yaml'
        path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
        return load_scenario(path, overrides)

    return write_and_load


@pytest.mark.parametrize('path', SCENARIOS, ids=lambda path: path.stem)
def test_our_scenarios_load_are_written_the_same_and_every_point_can_be_seen(path, load):
    scenario = load_scenario(path)
    assert never_seen(scenario) == ''
    targets = {'no_targets': 0, 'field': 8, 'field_batteries': 6, 'hills': 8}.get(path.stem, 12)
    for seed in range(10):
        assert len(scenario.world(seed).targets) == targets
    assert load(scenario.text()) == scenario


def test_layers_are_merged_key_by_key(load):
    scenario = load(changed(('robots.mambo.motion', {'speed': 0.3}), ('robots.mambo.radius', 0.2)))
    robot = scenario.robots['mambo']
    values = (robot.motion.speed, robot.motion.model, robot.radius, robot.link, robot.driver)
    assert values == (0.3, 'mambo', 0.2, 'topics', 'mambo_driver')
    # In 2D waypoints of a flying robot are at its height.
    candidates = robot_candidates(robot, scenario.environment).at([0, 0, 0])
    assert candidates.shape == (36, 3)
    assert set(candidates[:, 2]) == {1.0}


def test_types_beside_the_scenario_win_and_are_named_with_their_line(tmp_path, load):
    (tmp_path / 'robots').mkdir()
    source = (config_folder() / 'robots' / 'mambo.yaml').read_text()
    (tmp_path / 'robots' / 'mambo.yaml').write_text(source.replace('radius: 0.09', 'radius: 0.5'))
    assert load(PLAIN).robots['mambo'].radius == 0.5
    (tmp_path / 'robots' / 'slow.yaml').write_text(source.replace('speed: 0.4', 'speed: -1'))
    with pytest.raises(ScenarioError, match=r'robots/slow\.yaml:\d+: robots\.mambo\.motion\.speed'):
        load(changed(('robots.mambo.type', 'slow')))


LEAVES = {'at': 5.0, 'robot': 'mambo', 'do': 'leave'}
GRID, DISCS = 'robots.mambo.candidates', 'environment.obstacles'
TRUE = 'robots.mambo.simulated'
ROUND = [[-9, -9], [9, -9], [9, 9], [-9, 9]]
WRONG = [
    # What is changed, the key in the message, and words that it must hold.
    ([('plannr', {'name': 'asi'})], 'plannr', ["did you mean 'planner'", 'known are']),
    ([('filter.particels', 5)], 'filter.particels', ["did you mean 'particles'"]),
    ([('filter.preset', 'papr_000')], 'filter.preset', ["did you mean 'paper_000'", 'paper_0']),
    ([('robots.mambo.type', 'manbo')], 'robots.mambo.type', ["did you mean 'mambo'", 'turtlebot3']),
    ([('robots.mambo.driver', 'driver')], 'robots.mambo.driver', ['mambo_driver']),
    ([('step', 'fast')], 'step', ["read 'fast'", 'allowed is a number']),
    ([('step', float('nan'))], 'step', ['NaN', 'finite']),
    ([('step', -0.1)], 'step', ['read -0.1', 'greater than 0']),
    ([('version', 2)], 'version', ['unknown value 2', '1']),
    ([('version', None)], 'version', ['is missing']),
    ([('robots', {})], 'robots', ['at least 1 item, not 0']),
    ([('robots.mambo', 3)], 'robots.mambo', ['a mapping']),
    ([('robots.mambo.type', None)], 'robots.mambo.type', ['None', 'turtlebot3_burger']),
    ([('robots.mambo.start.1', 'x')], 'robots.mambo.start[1]', ["read 'x'", 'allowed is a number']),
    ([('robots.mambo.start', [0.5, 2.5, 1.0])], 'robots.mambo.start', ['environment.bounds']),
    ([('seed', 2**63)], 'seed', [f'read {2**63}', f'or equal to {2**63 - 1}']),
    ([(f'{GRID}.grid', [0, 6])], f'{GRID}.grid[0]', ['equal to 1']),
    ([(f'{GRID}.grid', [60, 6])], GRID, ['waypoints inside']),
    ([(f'{GRID}.spacing', None)], GRID, ['a grid needs it']),
    ([(GRID, {'grid': [2, 2, 2], 'spacing': 0.1})], f'{GRID}.grid', ['allowed in 2D']),
    ([(GRID, {'ring': 6, 'distance': 0.2})], f'{GRID}.ring', ['allowed in 2D']),
    ([('environment.bounds.0', [2.0, 0.0])], 'environment.bounds', ['lower < upper']),
    ([(DISCS, [{'centre': [0.5, 0.6], 'radius': 0.1}])], 'robots.mambo.start', [DISCS]),
    ([(DISCS, [{'centre': [1, 1, 0], 'radius': 0.1}])], f'{DISCS}[0].centre', ['allowed are 2']),
    *(
        ([(f'environment.{key}', value)], f'environment.{key}{inner}', [words])
        for key, value, inner, words in (
            ('area', [[0, 0], [1, 1]], '', 'at least 3 corners'),
            ('altitude', [0.0, 1.0], '', 'allowed with area'),
            ('keep_outs', ['circle'], '[0]', 'allowed is GeoJSON'),
            ('keep_outs', [ROUND], '', 'area'),
            ('obstacles', ['none.yaml'], '[0]', 'none.yaml'),
            ('prior', 'none.geojson', '', 'No such file'),
            ('prior', {'raster': 'none.npy'}, '.raster', 'No such file'),
            ('prior', {'polygons': [{'weight': 1.0, 'polygon': 'x'}]}, '.polygons[0].polygon', 'x'),
            ('prior', {'raster': 'a.npy', 'extent': [[0.0, 2.0], [2.0, 0.0]]}, '.extent', 'lower'),
            ('origin', {'latitude': 91.0, 'longitude': 9.0}, '.latitude', 'equal to 90'),
        )
    ),
    ([('robots.other', PLAIN['robots']['mambo'] | {'start': [0.6, 0.5, 1.0]})],
     'robots.other.start', ['0.1 m from the start of mambo', 'both radii, 0.18 m']),
    ([('environment', {'area': [[0, 0], [2, 0], [2, 0.27], [0, 0.27]]}), (GRID, None),
      ('robots.mambo.start', [0.5, 0.13, 1.0]), ('targets.margin', 0.0)],
     'robots.mambo.radius', ['read 0.09, with motion.clearance 0.05', 'too narrow']),
    ([('targets.margin', 1.5)], 'targets.margin', ['at most half']),
    ([('targets.count', 500)], 'targets.separation', ['not 500']),
    ([('targets', {'positions': [[0.5, 3.0]]})], 'targets.positions[0]', ['the bounds']),
    (
        [('targets', {'positions': [[0.5, 0.5], [0.2, 0.2], [0.5, 0.5]]})],
        'targets.positions[2]',
        ['targets.positions[0] is as well', 'one target at each position'],
    ),
    ([('targets', {})], 'targets', ['count or positions']),
    ([('targets', {'count': 2, 'classes': ['a', '']})], 'targets.classes[1]', ['at least 1 char']),
    ([('targets.count', 0)], 'stop', ['planner_done']),
    ([('robots.mambo.sensor.period', 0.12)], 'robots.mambo.sensor.period', ['multiples of step']),
    ([('robots.mambo.sensor.detection', {'lower': [0.0, 0.0, 0.0], 'upper': [1.0, 1.0]})],
     'robots.mambo.sensor.detection', ['2 or 3 numbers each']),
    ([('robots.mambo.driver', 'ranging_driver')], 'robots.mambo.camera', ['has none']),
    ([('targets.walk', 0.1)], 'robots.mambo.camera', ['targets.walk is 0.1']),
    ([(f'{TRUE}.clutter_per_scan', 1.0)], f'{TRUE}.clutter_per_scan', ['of ranging sensors']),
    ([('events', [LEAVES | {'robot': 'mamba'}])], 'events[0].robot', ["'mambo'"]),
    ([('events', [LEAVES | {'do': 'back'}])], 'events[0].do', ['is present']),
    ([('events', 2 * [LEAVES])], 'events[1].do', ['mambo has left']),
    *(
        ([(f'robots.{name}', PLAIN['robots']['mambo'] | {'start': [1.5, 1.5, 1.0]})],
         f'robots.{name}', [f"'{name}' as a name"])
        for name in ('Mambo', '1st', 'a-b', 'lockstep', 'two__bars')
    ),
    ([('step', 'fast'), ('stopp', 1)], 'stopp', ["unknown key 'stopp'", "step: read 'fast'"]),
]  # fmt: skip


@pytest.mark.parametrize(
    'changes, key, words', WRONG, ids=[f'{i}-{w[1]}' for i, w in enumerate(WRONG)]
)
def test_wrong_files_get_a_message_with_file_line_and_key(load, changes, key, words):
    with pytest.raises(ScenarioError) as caught:
        load(changed(*changes))
    message = str(caught.value)
    # A line for each.
    lines = message.splitlines()
    assert len(lines) == (1 if 'too narrow' in words else len(changes))
    places, _, rests = zip(*(line.partition(': ') for line in lines))
    assert all(re.search(r'\.yaml:\d+$', place) for place in places)
    assert any(rest.startswith(f'{key}: ') for rest in rests), message
    for word in words:
        assert word in message


DOCS = Path(__file__).parents[2] / 'docs'
LINKED = {'link': 'mavlink', 'mavlink': {'arm': True, 'url': 'udpin:127.0.0.1:14550'}}
WRONG_LINKS = [
    ('drone', {'mavlink': None}, 'drone.mavlink', 'is missing'),
    ('drone', {'mavlink': {'arm': False}}, 'drone.mavlink.arm', 'never takes off'),
    ('drone', {'mavlink': {'arm': True, 'url': 'tcp:a:1'}}, 'drone.mavlink.url', 'udpin'),
    ('drone', {'mavlink': {'arm': True, 'map_yaw': 0.1}}, 'drone.mavlink.map_yaw', 'is 0'),
    ('drone', {'autopilot': {'firmware': 'ardusub'}}, 'drone.mavlink.vehicle', "'ardusub'"),
    ('drone', {'start': [1.0, 1.0, 0.0]}, 'drone.start', 'above mavlink.ground'),
    ('rov', {'start': [1.0, 1.0, 1.0]}, 'rov.start', 'below mavlink.ground'),
    ('drone', {'guard': True}, 'drone.guard', 'timeout'),
    ('rov', {'mavlink': {'arm': True, 'url': 'udpin:127.0.0.1:14550'}}, 'rov.mavlink.url', 'drone'),
    ('drone', {'driver': 'ranging_driver'}, 'drone.link', 'does not have it'),
    ('mambo', {'mambo': {'arm': False}}, 'mambo.mambo.arm', 'read false, allowed is true'),
    ('mambo', {'mambo': {'arm': True}}, 'mambo.mambo.full_speed', 'is missing'),
    ('mambo', {'mambo': None}, 'mambo.mambo', r'is missing, .* at least \{arm: true'),
    ('mambo', {'mambo': {'arm': True, 'pose': 'pose'}}, 'mambo.mambo.pose', "read 'pose'"),
    ('mambo', {'start': [0.2, 0.6, 0.0]}, 'mambo.start', 'read height 0.0'),
    ('mambo', {'guard': True}, 'mambo.guard', 'read true'),
    ('mambo', {'driver': 'turtlebot_driver'}, 'mambo.link', "but driver 'turtlebot_driver'"),
    ('mambo', {'motion': {'model': 'constant_speed'}}, 'mambo.motion.model', 'constant_speed'),
]


@pytest.mark.parametrize('robot, changes, key, words', WRONG_LINKS)
def test_links_that_cannot_work_are_refused(load, robot, changes, key, words):
    name = 'mambo_turtlebot_wifi' if robot == 'mambo' else 'drone_rov'
    content = yaml.safe_load(find_scenario(name).read_text())
    if robot != 'mambo':
        content['robots']['drone'] |= LINKED
        content['robots']['rov'] |= {'link': 'mavlink', 'mavlink': {'arm': True}}
        assert load(content).robots['rov'].mavlink.system == 2
    for name, value in changes.items():
        content['robots'][robot][name] = value
    with pytest.raises(ScenarioError, match=words) as caught:
        load(content)
    assert f': robots.{key}: ' in str(caught.value)


def test_a_robot_may_be_moved_by_another_program(load):
    content = yaml.safe_load(find_scenario('drone_rov').read_text())
    link = LINKED['mavlink'] | {'url': 'tcp:127.0.0.1:5760', 'map_yaw': 0.1}
    content['robots']['drone'] |= LINKED | {'autopilot': 'external', 'mavlink': link}
    scenario = load(content)
    drone = scenario.robots['drone']
    assert drone.external and not drone.takes_off and not scenario.external_clock
    assert load(scenario.content()).robots['drone'].external
    assert load_scenario(DOCS / 'drone_sitl.yaml').robots['drone'].external
    content['events'] = [{'at': 5.0, 'robot': 'drone', 'do': 'leave'}]
    content['robots']['drone']['simulated'] = {'noise_factor': 2.0}
    with pytest.raises(ScenarioError, match=r"events\[0\]\.robot: read 'drone'") as caught:
        load(content)
    assert 'robots.drone.simulated: ' in str(caught.value)
    scenario = load(changed(('robots.mambo.body', 'external')))
    mambo = scenario.robots['mambo']
    assert mambo.external and not mambo.takes_off and scenario.external_clock
    scenario.check_pace(False, None)
    with pytest.raises(ScenarioError, match=r'robots\.mambo\.body: read .external., but lock'):
        scenario.check_pace(True, None)


def test_a_drone_may_be_flown_by_another_system(load):
    platform = {'namespace': 'cf7', 'arm': True}
    linked = PLAIN['robots']['mambo'] | {'link': 'crazyswarm2', 'driver': 'camera_driver'}
    scenario = load(changed(('robots.mambo', linked | {'platform': platform})))
    mambo = scenario.robots['mambo']
    assert mambo.external and not mambo.takes_off and not scenario.external_clock
    for wrong, words in (
        (None, r'mambo\.platform: is missing, .* \{arm: true, namespace: '),
        (platform | {'arm': False}, r'mambo\.platform\.arm: read false'),
        (platform | {'namespace': 'mambo'}, r"platform\.namespace: read 'mambo', the name of the"),
        (platform | {'voltages': [4.2, 3.7]}, r'platform'),
    ):
        with pytest.raises(ScenarioError, match=words):
            load(changed(('robots.mambo', linked | {'platform': wrong})))


def test_a_drone_with_a_camera_may_be_linked_by_mavlink(load):
    robot = ('robots.mambo', PLAIN['robots']['mambo'] | LINKED)
    driver = ('robots.mambo.driver', 'mavlink_camera_driver')
    assert load(changed(robot, driver)).robots['mambo'].link == 'mavlink'
    for change, words in (
        (('robots.mambo.driver', 'mavlink_driver'), r'robots\.mambo\.camera: read one'),
        (('robots.mambo.body', 'external'), r'robots\.mambo\.body: .* with link mavlink'),
    ):
        with pytest.raises(ScenarioError, match=words):
            load(changed(robot, driver, change))


def test_the_line_is_that_of_the_key(load):
    text = yaml.safe_dump(changed(('stepp', {'a': 3})), sort_keys=False)
    line = text.splitlines().index('stepp:') + 1
    with pytest.raises(ScenarioError, match=f'my_scenario.yaml:{line}: stepp'):
        load(text)
    # Of an item of a list, where settings do not fit together.
    text = yaml.safe_dump(changed(('events', [LEAVES, LEAVES | {'do': 'leave'}])))
    line = len(text.splitlines()) - text.splitlines()[::-1].index('  do: leave')
    with pytest.raises(ScenarioError, match=rf'my_scenario.yaml:{line}: events\[1\]\.do'):
        load(text)


@pytest.mark.parametrize(
    ('name', 'words'),
    [
        ('missing.yaml', 'No such file'),
        ('.', 'Is a directory'),
        ('binary.yaml', 'not text'),
        ('mamb', "did you mean 'mambo'"),
    ],
)
def test_files_that_cannot_be_read_are_named(tmp_path, name, words):
    (tmp_path / 'binary.yaml').write_bytes(b'\xff\xfe\x00')
    with pytest.raises(ScenarioError, match=words):
        load_scenario(name if name == 'mamb' else tmp_path / name)


BOMB = 'a0: &a0 [x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'a{n}: &a{n} [{", ".join([f"*a{n - 1}"] * 9)}]\n' for n in range(1, 12)
)


@pytest.mark.parametrize(
    'text, words',
    [
        ('', 'read null, a mapping of keys'),
        ('- a\n- b\n', 'a mapping of keys is needed'),
        ('version: 1\nstep: [0.05\n', 'is not YAML'),
        ('version: 1\nversion: 1\n', 'version: is repeated'),
        ('version: 1\n3: 1\n', 'read 3 as a key'),
        ('version: !!python/object:os.system 1\n', 'is not YAML'),
        ('version: 1\nx: &a [*a]\n', ':2: an alias refers to its own anchor'),
        ('x: &a {b: {c: *a}}\n', ':1: an alias refers to its own anchor'),
        ('version: 1\nname: a\x07b\n', ':2: is not YAML: read character 0x7'),
        (BOMB, 'read more than 100000 entries'),
        ('x: ' + '[' * 3000 + ']' * 3000 + '\n', 'nested too deeply'),
        ('a' * 5000 + '\n', "read 'aaaa"),
    ],
)
def test_what_is_no_scenario_is_refused_in_one_short_line(load, text, words):
    with pytest.raises(ScenarioError, match=words) as caught:
        load(text)
    message = str(caught.value)
    assert 'my_scenario.yaml' in message and '\n' not in message
    assert len(message.partition('my_scenario.yaml')[2]) < 250


@pytest.mark.parametrize(
    'robot',
    [
        {'type': 'mambo'},
        {'type': 'turtlebot3_burger'},
        {'type': 'mambo', 'sensor': {'detection': {'kind': 'gaussian', 'size': [0.3, 0.2]}}},
    ],
    ids=lambda robot: '-'.join(robot),
)
def test_a_robot_without_candidates_gets_a_grid_that_sees_everything(load, robot):
    content = changed(('robots', {'one': robot | {'start': [0.5, 0.5, 1.0]}}))
    content['environment']['origin'] = {'latitude': 46.0, 'longitude': 23.5}
    scenario = load(content)
    assert never_seen(scenario) == ''
    numbers = scenario.robots['one'].candidates.grid
    assert min(numbers) >= 2 and max(numbers) <= 25
    # It is part of the scenario that a run leaves.
    assert load(scenario.text()).robots['one'].candidates.grid == numbers
    # Other errors are named.
    content['robots']['one']['radius'] = -1.0
    with pytest.raises(ScenarioError, match=r'^\S+:\d+: robots\.one\.radius: read -1'):
        load(content)


def test_what_wins_over_a_file_hides_none_of_its_errors(load):
    overrides = {'--seed': (('seed',), 3), '--planner': (('planner', 'name'), 'asi')}
    with pytest.raises(ScenarioError, match=r"scenario\.yaml:\d+: seed: read 'abc'") as caught:
        load(changed(('seed', 'abc'), ('planner', 5)), overrides)
    assert 'planner: read 5' in str(caught.value)
    assert load(PLAIN, overrides).planner.name == 'asi'


def test_planners_of_another_kind_of_search_are_refused_in_one_line():
    for scenario, planner, kind in (
        ('mambo', 'cuboid_mpc', 'target search'),
        ('buildings_one', 'maasi', 'search of buildings'),
    ):
        with pytest.raises(ScenarioError) as caught:
            load_mission(scenario, {'--planner': (('planner', 'name'), planner)})
        (line,) = str(caught.value).splitlines()
        assert line.startswith(f"--planner: read '{planner}'; ") and kind in line


def test_messages_name_files_not_links_to_them(tmp_path, monkeypatch):
    share = tmp_path / 'share'
    (share / 'robots').mkdir(parents=True)
    for file in (config_folder() / 'robots').glob('*.yaml'):
        (share / 'robots' / file.name).symlink_to(file)
    monkeypatch.setattr(
        'ament_index_python.packages.get_package_share_directory', lambda name: str(share)
    )
    assert config_folder() == Path(__file__).resolve().parents[2] / 'config'


def test_what_is_unusual_is_taken(load):
    text = yaml.safe_dump(changed(('planner.gain_threshold', 0.5)))
    scenario = load(text.replace('gain_threshold: 0.5', 'gain_threshold: 1e-4'))
    assert scenario.planner.gain_threshold == 1e-4
    # Events in any order.
    events = [(20.0, 'back'), (10.0, 'leave'), (30.0, 'leave')]
    content = [{'at': at, 'robot': 'mambo', 'do': do} for at, do in events]
    assert len(load(changed(('events', content))).events) == 3


def test_waypoints_on_one_side_get_a_warning_that_names_the_unseen_part(load):
    points = ('robots.mambo.candidates', {'points': [[0.3, 0.2], [0.3, 1.8]]})
    warning = never_seen(load(changed(points, ('robots.mambo.start', [0.3, 1.0, 1.0]))))
    assert 'can never be seen' in warning
    assert 'x 0.494 to 1.9 m' in warning
    # Candidates that move with the robot get none.
    ring = ('robots.mambo.candidates', {'ring': 4, 'distance': 0.25})
    assert never_seen(load(changed(ring))) == ''


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ([('events', [LEAVES | {'at': 20.0}])], r'events\[0\]\.at: read 20, .* run ends at 5 s'),
        ([('robots.mambo.yaw', 180)], r'robots\.mambo\.yaw: read 180, .* degrees are 3\.142'),
        (
            [('environment.keep_outs', [{'centre': [5.0, 1.0], 'radius': 0.5}])],
            r'environment\.keep_outs\[0\]: lies 2\.5 m outside of the area',
        ),
        (
            [('environment.prior', {'polygons': [{'weight': 0.0, 'polygon': ROUND}]})],
            r'environment\.prior: .* evenly',
        ),
        (
            [
                ('robots.mambo.endurance', {'per_second': 0.001}),
                ('robots.mambo.battery', {'charging_power': 0.0}),
            ],
            r'robots\.mambo\.battery\.charging_power: read 0',
        ),
        ([('robots.mambo.endurance', {})], r'robots\.mambo\.endurance: .*per_second and per_metre'),
        ([('simulated', {'wind': [0.3, 0.3]})], r'simulated\.wind: .* mambo, 0\.4 m/s: .* away'),
        (
            [
                ('environment.keep_outs', [{'centre': [0.7, 0.5], 'radius': 0.15}]),
                ('environment.bounds', [[0.0, 2.0], [0.0, 2.0]]),
            ],
            r'robots\.mambo\.start: .* 0\.05 m from the border',
        ),
    ],
)
def test_what_is_hardly_meant_is_taken_with_a_warning(load, changes, words):
    load(changed(('robots.mambo.yaw', -3.0)))
    with pytest.warns(ScenarioWarning, match=rf'my_scenario.yaml:\d+: {words}'):
        load(changed(*changes), {'--time-limit': (('limits', 'time'), 5.0)})
    # What a program made gets none.
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        scenario_from_values(changed(('limits.time', 5.0), *changes), 'a program')

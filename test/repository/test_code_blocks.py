"""Code blocks of the documents: Python is run, YAML is validated, options of commands exist."""

import argparse
import importlib
import re
import shlex
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml
from markdown_it import MarkdownIt

from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.ros.node_parameters import check
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import parameter_fields
from maasi_sim.run.run_options import launch_arguments
from maasi_sim.scenario.layering import merge, to_yaml
from maasi_sim.scenario.loading import find_scenario, load_scenario, read_layer
from maasi_sim.scenario.schema import RobotSettings, Scenario

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md']
DOCUMENTS += [path for name in ('docs', 'examples') for path in sorted((ROOT / name).rglob('*.md'))]
NODES = {'filter_node': FilterNodeSettings, '/**': DriverSettings}


class Block(NamedTuple):
    place: str
    language: str
    text: str


def blocks(text, name):
    """Yield the code blocks of a document that are not marked as not run."""
    marked = False
    for token in MarkdownIt().parse(text):
        if token.type == 'html_block':
            marked = re.fullmatch(r'<!-- not run: \S.*-->', token.content.strip()) is not None
        elif token.type in ('fence', 'code_block'):
            language = token.info.strip() or guess(token.content)
            if not marked and language not in ('text', 'mermaid'):
                yield Block(f'{name}:{token.map[0] + 1}', language, token.content)
            marked = False
        elif token.type == 'inline':
            marked = False


def guess(text):
    """Return the language of a block that does not say it."""
    if re.match(r'(from|import) \w', text):
        return 'python'
    return 'yaml' if re.match(r"\s*[\w.'/*]+:\s", text) else 'sh'


BLOCKS = [
    block
    for path in DOCUMENTS
    for block in blocks(path.read_text(), path.relative_to(ROOT).as_posix())
]


def of(language):
    chosen = [block for block in BLOCKS if block.language == language]
    # The program of the README is run by test_pip_install.py.
    if language == 'python':
        chosen = [block for block in chosen if not block.place.startswith('README')]
    return pytest.mark.parametrize('block', chosen, ids=lambda block: block.place)


def test_each_block_has_a_language_that_is_checked():
    assert {item.language for item in BLOCKS} == {'python', 'yaml', 'sh'}
    text = 'A\n\n<!-- not run: flies -->\n```sh\nx\n```\n\n    ./scripts/demo\n\n```text\nx\n```\n'
    assert [(block.place, block.language) for block in blocks(text, 'a.md')] == [('a.md:8', 'sh')]


@of('python')
def test_python(block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('MPLBACKEND', 'Agg')
    exec(compile(block.text, block.place, 'exec'), {'__name__': '__main__'})


def check_yaml(text, folder):
    """Validate a scenario, a part of one, a robot type, or parameters of a node."""
    file = folder / 'block.yaml'
    file.write_text(text)
    layer = read_layer(file)
    keys = set(layer.data)
    if keys <= set(NODES):
        for name, content in layer.data.items():
            assert check(NODES[name], flat(content['ros__parameters']))[1] == {}
        return
    if {'version', 'robots'} <= keys:
        whole = layer.data
    elif keys <= set(Scenario.model_fields):
        whole = merge(read_layer(find_scenario('mambo_turtlebot')), layer).data
    elif keys <= set(RobotSettings.model_fields):
        (folder / 'robots').mkdir()
        (folder / 'robots' / 'block.yaml').write_text(text)
        whole = yaml.safe_load(find_scenario('mambo').read_text())
        whole['robots'] = {'robot': {'type': 'block', 'start': [0.5, 0.5, 0.0]}}
    else:
        known = {item.name for item in parameter_fields(DriverSettings, flat(layer.data))}
        assert keys <= known, keys - known
        return
    file.write_text(to_yaml(whole))
    load_scenario(file)


def flat(values, prefix=''):
    result = {}
    for key, value in values.items():
        whole = prefix + key
        result |= flat(value, f'{whole}.') if isinstance(value, dict) else {whole: value}
    return result


@of('yaml')
def test_yaml(block, tmp_path):
    check_yaml(block.text, tmp_path)


WRONG_YAML = (
    'filter: {filters: pmb}',
    'planner: {name: fastest}',
    'camera.widht: 640',
    'filter_node: {ros__parameters: {environment.bounds: [0.0, 1.0, 0.0]}}',
    'driver: ranging_driver\nmotion: {speed: -1.0}',
)
WRONG_COMMANDS = (
    './scripts/run_scenario mambo --sed 1',
    './scripts/run_scenario mambo --seed 1.5',
    './scripts/gone',
    './scripts/golden --wrote',
    './scripts/chaos [--cases NAME ...]',
    'ros2 run maasi_filter filter --ros-args',
    'ros2 run maasi_filter filter_node --fast',
    'ros2 launch maasi_sim scenario.launch.py scenarios:=mambo',
    'ros2 service call /search/keep_outs maasi_msgs/srv/SetKeepOuts "{zone: []}"',
    'ros2 service call /search/a maasi_msgs/srv/ReviewTarget "{id: one}"',
)


def test_what_is_wrong_is_found(tmp_path):
    for check_block, texts in (
        (lambda text: check_yaml(text, tmp_path), WRONG_YAML),
        (check_commands, WRONG_COMMANDS),
    ):
        for text in texts:
            with pytest.raises((ValueError, AssertionError, OSError, AttributeError)):
                check_block(text)


def check_commands(text):
    """Check that the commands of ours in a block exist, and take their options."""
    # A line that is indented goes on.
    text = re.sub(r'\$\(.*?\)', 'X', re.sub(r'\\?\n\s+', ' ', text.strip()))
    for part in re.split(r'\n| && | ; ', text):
        words = shlex.split(part, comments=True)
        while words and re.match(r'[A-Z_]+=', words[0]):
            words.pop(0)
        if words:
            check_command(*words)


def check_command(program, *rest):
    if program.startswith('./scripts/'):
        check_script(ROOT / program, rest)
    elif program == 'ros2' and rest[:2] == ('service', 'call'):
        check_request(*rest[3:])
    elif program == 'ros2' and rest[1].startswith('maasi'):
        verb, package, name, *arguments = rest
        if verb == 'run':
            commands = vars(importlib.import_module(f'{package}_entry'))
            assert name in commands, rest
            (target,) = commands[name].args
            check_module(target.partition(':')[0], arguments)
        else:
            launch = (ROOT / package / 'launch' / name).read_text()
            given = {argument.partition(':=')[0] for argument in arguments}
            assert all(item in launch_arguments() or f"'{item}'" in launch for item in given)
    elif program.startswith('python') and rest[0] == '-m' and rest[1].startswith('maasi'):
        check_module(rest[1], rest[2:])
    elif program.startswith('python') and rest[0].endswith('.py'):
        name = Path(rest[0]).name
        assert any(ROOT.glob(f'scripts/{name}')) or any(ROOT.glob(f'examples/**/{name}')), name


def check_request(kind, text='{}'):
    package, folder, name = kind.split('/')
    request = getattr(importlib.import_module(f'{package}.{folder}'), name).Request()
    fill(request, yaml.safe_load(text))


def fill(message, values):
    for key, value in values.items():
        field = getattr(message, key)
        if isinstance(value, dict):
            fill(field, value)
        else:
            setattr(message, key, type(field)(value))


def check_script(script, arguments):
    text = script.read_text()
    module = re.search(r'python -m (\S+) "\$@"', text)
    file = re.search(r'python "\$maasi_root/(\S+)" "\$@"', text)
    if script.name == 'shell':
        check_command(*arguments)
    elif script.name == 'demo':
        check_module('maasi_sim.run.run_options', ['mambo_turtlebot', *arguments])
    elif module:
        check_module(module[1], arguments)
    elif file:
        # Options that several commands have are added in a module next to them.
        texts = [path.read_text() for path in (ROOT / file[1]).parent.glob('*.py')]
        check_options(arguments, re.findall(r"'(--[\w-]+)'", '\n'.join(texts)))


def check_module(name, arguments):
    if name == 'maasi_sim.run.run_scenario':
        name = 'maasi_sim.run.run_options'
    module = importlib.import_module(name)
    if not hasattr(module, 'build_parser'):
        # A node: what follows is for ROS.
        assert not arguments or arguments[0] in ('--ros-args', '--help'), arguments
        return
    parser = module.build_parser()
    known = set(parser._option_string_actions)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            known.update(*(item._option_string_actions for item in action.choices.values()))
    check_options(arguments, known)
    # A line of usage has choices, and names for values.
    if not re.search(r'[\[\]|]|\.\.\.', ' '.join(arguments)) and '--help' not in arguments:
        try:
            parser.parse_args([word for word in arguments if word != '&'])
        except SystemExit as leaving:
            raise AssertionError(f'{name} refuses {arguments}') from leaving


def check_options(arguments, known):
    unknown = set(re.findall(r'--[a-z][\w-]*', ' '.join(arguments))) - set(known)
    assert not unknown, f'unknown options: {sorted(unknown)}'


@of('sh')
def test_commands(block):
    check_commands(block.text)

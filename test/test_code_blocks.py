"""Code blocks of the documents: Python is run, YAML is validated, options of commands exist.

A block that cannot be run here has `<!-- not run: REASON -->` before it; one that is no code is
fenced as text.
"""

from __future__ import annotations

import argparse
import importlib
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from markdown_it import MarkdownIt

import maasi_entry
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.ros.node_parameters import check
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import parameter_fields
from maasi_sim.run.launch_arguments import ARGUMENTS
from maasi_sim.scenario.layering import merge, to_yaml
from maasi_sim.scenario.loading import find_scenario, load_scenario, read_layer
from maasi_sim.scenario.schema import RobotSettings, Scenario

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [
    ROOT / 'README.md',
    ROOT / 'CONTRIBUTING.md',
    *sorted((ROOT / 'docs').rglob('*.md')),
    *sorted((ROOT / 'examples').rglob('*.md')),
]
NOT_CODE = ('text', 'mermaid')
NODES = {'filter_node': FilterNodeSettings, '/**': DriverSettings}


@dataclass(frozen=True)
class Block:
    place: str
    language: str
    text: str


def blocks(text: str, name: str) -> Iterator[Block]:
    """Yield the code blocks of a document that are not marked as not run."""
    marked = False
    for token in MarkdownIt().parse(text):
        if token.type == 'html_block':
            marked = re.fullmatch(r'<!-- not run: \S.*-->', token.content.strip()) is not None
        elif token.type in ('fence', 'code_block'):
            language = token.info.strip() or guess(token.content)
            if not marked and language not in NOT_CODE:
                yield Block(f'{name}:{token.map[0] + 1}', language, token.content)
            marked = False
        elif token.type == 'inline':
            marked = False


def guess(text: str) -> str:
    """Return the language of a block that does not say it."""
    first = text.split()[0] if text.split() else ''
    if re.match(r'(from|import) \w', text):
        return 'python'
    if re.fullmatch(r"[\w.'/*]+:", first):
        return 'yaml'
    return 'sh'


BLOCKS = [
    block
    for path in DOCUMENTS
    for block in blocks(path.read_text(), path.relative_to(ROOT).as_posix())
]


def of(*languages: str) -> pytest.MarkDecorator:
    # The program of the README is run by test_pip_install.py.
    chosen = [
        block
        for block in BLOCKS
        if block.language in languages
        and not (block.language == 'python' and block.place.startswith('README'))
    ]
    return pytest.mark.parametrize('block', chosen, ids=lambda block: block.place)


def test_each_block_has_a_language_that_is_checked() -> None:
    known = ('python', 'yaml', 'sh')
    assert [(item.place, item.language) for item in BLOCKS if item.language not in known] == []
    assert {item.language for item in BLOCKS} == set(known)


@of('python')
def test_python(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('MPLBACKEND', 'Agg')
    exec(compile(block.text, block.place, 'exec'), {'__name__': '__main__'})


# ---- YAML ------------------------------------------------------------------------------------


def check_yaml(text: str, folder: Path) -> None:
    """Validate a scenario, a part of one, a robot type, or parameters of a node."""
    file = folder / 'block.yaml'
    file.write_text(text)
    layer = read_layer(file)
    keys = set(layer.data)
    if {'version', 'robots'} <= keys:
        load_scenario(file)
    elif keys <= set(NODES):
        for name, content in layer.data.items():
            values = flat(content['ros__parameters'])
            assert check(NODES[name], values)[1] == {}
    elif keys <= set(Scenario.model_fields):
        file.write_text(to_yaml(merge(read_layer(find_scenario('mambo_turtlebot')), layer).data))
        load_scenario(file)
    elif keys <= set(RobotSettings.model_fields):
        (folder / 'robots').mkdir()
        (folder / 'robots' / 'block.yaml').write_text(text)
        base = yaml.safe_load(find_scenario('mambo').read_text())
        base['robots'] = {'robot': {'type': 'block', 'start': [0.5, 0.5, 0.0]}}
        file.write_text(to_yaml(base))
        load_scenario(file)
    else:
        known = {item.name for item in parameter_fields(DriverSettings, flat(layer.data))}
        assert keys <= known, keys - known


def flat(values: dict[str, Any], prefix: str = '') -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in values.items():
        inner = flat(value, f'{prefix}{key}.') if isinstance(value, dict) else {prefix + key: value}
        result.update(inner)
    return result


@of('yaml')
def test_yaml(block: Block, tmp_path: Path) -> None:
    check_yaml(block.text, tmp_path)


@pytest.mark.parametrize(
    'text',
    [
        'filter: {filters: pmb}',
        'planner: {name: fastest}',
        'camera.widht: 640',
        'filter_node: {ros__parameters: {environment.bounds: [0.0, 1.0, 0.0]}}',
        'driver: ranging_driver\nmotion: {speed: -1.0}',
    ],
)
def test_wrong_yaml_is_found(text: str, tmp_path: Path) -> None:
    with pytest.raises((ValueError, AssertionError)):
        check_yaml(text, tmp_path)


# ---- commands --------------------------------------------------------------------------------


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of each command of a block, without variables before it."""
    # A line that is indented goes on.
    text = re.sub(r'\\?\n\s+', ' ', text.strip())
    for line in text.splitlines():
        for part in re.split(r' && | ; ', re.sub(r'\$\(.*?\)', 'X', line)):
            words = shlex.split(part, comments=True)
            while words and re.match(r'[A-Z_]+=', words[0]):
                words.pop(0)
            if words:
                yield words


def module_of(package: str, executable: str) -> str:
    """Return the module that `ros2 run` runs."""
    entries = (ROOT / package / 'setup.py').read_text()
    assert f"'{executable} = maasi_entry:{executable}'" in entries, f'{package}: no {executable}'
    (target,) = getattr(maasi_entry, executable).args
    return target.partition(':')[0]


def check_command(words: list[str]) -> None:
    """Check that a command of ours exists and takes its options."""
    program, *rest = words
    if program.startswith('./scripts/'):
        check_script(ROOT / program, rest)
    elif program == 'ros2' and rest[1].startswith('maasi'):
        if rest[0] == 'run':
            check_module(module_of(rest[1], rest[2]), rest[3:])
        else:
            launch = (ROOT / rest[1] / 'launch' / rest[2]).read_text()
            names = {argument.partition(':=')[0] for argument in rest[3:]}
            assert all(name in ARGUMENTS or f"'{name}'" in launch for name in names)
    elif program.startswith('python') and rest[0] == '-m' and rest[1].startswith('maasi'):
        check_module(rest[1], rest[2:])
    elif program.startswith('python') and rest[0].endswith('.py'):
        name = Path(rest[0]).name
        assert any(ROOT.glob(f'scripts/{name}')) or any(ROOT.glob(f'examples/**/{name}')), name


def check_script(script: Path, arguments: list[str]) -> None:
    text = script.read_text()
    module = re.search(r'python -m (\S+) "\$@"', text)
    file = re.search(r'python "\$maasi_root/(\S+)" "\$@"', text)
    if script.name == 'shell':
        check_command(arguments)
    elif script.name == 'demo':
        check_module('maasi_sim.run.run_options', ['mambo_turtlebot', *arguments])
    elif module:
        check_module(module[1], arguments)
    elif file:
        known = re.findall(r"'(--[\w-]+)'", (ROOT / file[1]).read_text())
        check_options(arguments, set(known))


def check_module(name: str, arguments: list[str]) -> None:
    if name == 'maasi_sim.run.run_scenario':
        name = 'maasi_sim.run.run_options'
    module = importlib.import_module(name)
    if not hasattr(module, 'build_parser'):
        # A node: what follows is for ROS.
        assert not arguments or arguments[0] in ('--ros-args', '--help'), arguments
        return
    parser: argparse.ArgumentParser = module.build_parser()
    check_options(arguments, set(parser._option_string_actions))
    # A line of usage has choices, and names for values.
    if not re.search(r'[\[\]|]|\.\.\.', ' '.join(arguments)) and '--help' not in arguments:
        try:
            parser.parse_args([word for word in arguments if word != '&'])
        except SystemExit as leaving:
            raise AssertionError(f'{name} refuses {arguments}') from leaving


def check_options(arguments: list[str], known: set[str]) -> None:
    given = set(re.findall(r'--[a-z][\w-]*', ' '.join(arguments)))
    assert given <= known, f'unknown options: {sorted(given - known)}'


@of('sh')
def test_commands(block: Block) -> None:
    for words in commands(block.text):
        check_command(words)


@pytest.mark.parametrize(
    'line',
    [
        './scripts/run_scenario mambo --sed 1',
        './scripts/run_scenario mambo --seed 1.5',
        './scripts/gone',
        './scripts/golden --wrote',
        './scripts/chaos [--cases NAME ...]',
        'ros2 run maasi_filter filter --ros-args',
        'ros2 run maasi_filter filter_node --fast',
        'ros2 launch maasi_sim scenario.launch.py scenarios:=mambo',
    ],
)
def test_wrong_commands_are_found(line: str) -> None:
    with pytest.raises((AssertionError, OSError)):
        for words in commands(line):
            check_command(words)


def test_marked_blocks_are_left_out() -> None:
    text = 'A\n\n<!-- not run: flies -->\n```sh\nx\n```\n\n    ./scripts/demo\n\n```text\nx\n```\n'
    assert [(block.place, block.language) for block in blocks(text, 'a.md')] == [('a.md:8', 'sh')]

"""The Dockerfile and the development container name only what is there."""

from __future__ import annotations

import json
import re
import subprocess
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KEYS = {'name', 'build', 'remoteUser', 'postCreateCommand', 'customizations'}


def instructions() -> list[tuple[str, str]]:
    """Return the instructions of the Dockerfile with their arguments."""
    lines = (ROOT / 'Dockerfile').read_text().splitlines()
    text = '\n'.join(line for line in lines if not line.lstrip().startswith('#'))
    joined = text.replace('\\\n', ' ').splitlines()
    return [(line.split(' ', 1)[0], line.split(' ', 1)[1]) for line in joined if line.strip()]


def arguments(name: str) -> list[str]:
    return [argument for instruction, argument in instructions() if instruction == name]


def ignored(path: str) -> bool:
    patterns = (ROOT / '.dockerignore').read_text().split()
    return any(fnmatch(path, pattern.removeprefix('**/')) for pattern in patterns)


def test_instructions_are_known_and_commands_are_valid_shell() -> None:
    known = {'FROM', 'SHELL', 'WORKDIR', 'ENV', 'COPY', 'RUN', 'ENTRYPOINT', 'CMD'}
    assert {name for name, _ in instructions()} <= known
    assert instructions()[0][0] == 'FROM'
    for command in arguments('RUN'):
        subprocess.run(['bash', '-n', '-c', command], check=True)
    for name in ('SHELL', 'ENTRYPOINT', 'CMD'):
        for words in map(json.loads, arguments(name)):
            assert words and all(isinstance(word, str) for word in words)


def test_what_is_copied_and_run_exists() -> None:
    copied = [argument.split() for argument in arguments('COPY')]
    for source, target in copied:
        assert (ROOT / source).exists() and not ignored(source)
        assert target in ('src/', f'src/{Path(source).parent}/')
    for path in re.findall(r'\bsrc/([\w./-]+)', ' '.join(arguments('RUN'))):
        assert (ROOT / path).is_file()


def test_dependencies_are_those_of_all_packages() -> None:
    manifests = {path.relative_to(ROOT).as_posix() for path in ROOT.glob('*/package.xml')}
    copied = {argument.split()[0] for argument in arguments('COPY')}
    assert manifests == {path for path in copied if path.endswith('package.xml')}


def test_the_development_container_is_a_stage_of_the_image() -> None:
    file = ROOT / '.devcontainer' / 'devcontainer.json'
    container = json.loads(file.read_text())
    assert set(container) <= KEYS
    build = container['build']
    assert (file.parent / build['dockerfile']).resolve() == ROOT / 'Dockerfile'
    assert (file.parent / build['context']).resolve() == ROOT
    stages = [words.split(' AS ') for words in arguments('FROM')]
    assert build['target'] in [name for _, name in stages]
    # Each begins with a published image, or with a stage before it.
    names = ['ros:jazzy']
    for image, name in stages:
        assert image in names
        names.append(name)
    for path in re.findall(r'\./(scripts/\w+)', container['postCreateCommand']):
        assert (ROOT / path).is_file()

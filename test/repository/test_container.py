"""The Dockerfile and the development container name only what is there."""

import json
import re
import subprocess
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def arguments(name):
    """Return the arguments of each such instruction of the Dockerfile."""
    lines = (ROOT / 'Dockerfile').read_text().splitlines()
    text = '\n'.join(line for line in lines if not line.lstrip().startswith('#'))
    return re.findall(rf'^{name} (.*)$', text.replace('\\\n', ' '), re.MULTILINE)


def test_commands_are_valid_and_what_is_copied_and_run_exists():
    for command in arguments('RUN'):
        subprocess.run(['bash', '-n', '-c', command], check=True)
        for path in re.findall(r'\bsrc/([\w./-]+)', command):
            assert (ROOT / path).is_file()
    for words in map(json.loads, arguments('(?:SHELL|ENTRYPOINT|CMD)')):
        assert words and all(isinstance(word, str) for word in words)
    ignored = (ROOT / '.dockerignore').read_text().replace('**/', '').split()
    copied = dict(argument.split() for argument in arguments('COPY'))
    for source, target in copied.items():
        assert (ROOT / source).exists()
        assert not any(fnmatch(source, pattern) for pattern in ignored)
        assert target in ('src/', f'src/{Path(source).parent}/')
    # Dependencies are those of all packages.
    manifests = {path.relative_to(ROOT).as_posix() for path in ROOT.glob('*/package.xml')}
    assert manifests == {source for source in copied if source.endswith('package.xml')}


def test_the_development_container_is_a_stage_of_the_image():
    file = ROOT / '.devcontainer' / 'devcontainer.json'
    container = json.loads(file.read_text())
    build = container['build']
    assert (file.parent / build['dockerfile']).resolve() == ROOT / 'Dockerfile'
    assert (file.parent / build['context']).resolve() == ROOT
    # Each begins with a published image, or with a stage before it.
    names = ['ros:jazzy']
    for image, name in (words.split(' AS ') for words in arguments('FROM')):
        assert image in names
        names.append(name)
    assert build['target'] in names
    for path in re.findall(r'\./(scripts/\w+)', container['postCreateCommand']):
        assert (ROOT / path).is_file()

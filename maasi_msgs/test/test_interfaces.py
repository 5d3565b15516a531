"""Messages, services and actions: each is generated, and each field is described."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(path for kind in ('msg', 'srv', 'action') for path in ROOT.glob(f'{kind}/*'))
PARTS = {'.msg': [], '.srv': ['Request', 'Response'], '.action': ['Goal', 'Result', 'Feedback']}
CONSTANT = re.compile(r'\w+ [A-Z_]+=')
files = pytest.mark.parametrize('path', FILES, ids=lambda path: path.stem)


@files
def test_an_interface_is_generated(path):
    kind = getattr(importlib.import_module(f'maasi_msgs.{path.parent.name}'), path.stem)
    parts = [getattr(kind, name) for name in PARTS[path.suffix]] or [kind]
    for part in parts:
        message = part()
        for name in part.get_fields_and_field_types():
            assert hasattr(message, name)


@files
def test_each_field_is_described(path):
    lines = [line for line in path.read_text().splitlines() if line not in ('', '---')]
    fields = [line for line in lines if not line.startswith('#') and not CONSTANT.match(line)]
    assert fields and [line for line in fields if '#' not in line] == []

"""Files that are read at run time: each can be read, and names only what is there."""

import json
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize('path', sorted((ROOT / 'scenarios').glob('*.yaml')), ids=lambda x: x.stem)
def test_robots_of_a_scenario_have_a_type(path):
    types = {file.stem: yaml.safe_load(file.read_text()) for file in ROOT.glob('robots/*.yaml')}
    assert all(isinstance(content, dict) for content in types.values())
    robots = yaml.safe_load(path.read_text())['robots'].values()
    assert robots and {robot['type'] for robot in robots} <= types.keys() - {'all'}


def test_views_can_be_read():
    views = [yaml.safe_load(path.read_text()) for path in (ROOT / 'rviz').glob('*.rviz')]
    assert views and all(view['Visualization Manager']['Displays'] for view in views)
    layouts = [json.loads(path.read_text()) for path in (ROOT / 'foxglove').glob('*.json')]
    assert layouts and all(layout['configById'] for layout in layouts)

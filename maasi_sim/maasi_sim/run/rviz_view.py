"""RViz configurations of a run: those of maasi_config with the cameras of its robots."""

from pathlib import Path
from typing import Any

import yaml

from maasi_sim.run.mission import Mission
from maasi_sim.scenario.loading import config_folder


def view_text(mission: Mission[Any], namespace: str = '') -> str:
    """Return RViz's configuration for a run of a scenario, in the namespace of a team."""
    name = 'search_3d' if mission.scenario.dimension == 3 else 'search'
    path = config_folder() / 'rviz' / f'{name}.rviz'
    content = yaml.safe_load(path.read_text(encoding='utf-8'))
    displays: list[dict[str, Any]] = content['Visualization Manager']['Displays']
    team = f'/{namespace}' if namespace else ''
    for display in displays:
        if 'Topic' in display:
            display['Topic']['Value'] = team + display['Topic']['Value']
    for robot, settings in sorted(mission.scenario.robots.items()):
        if getattr(settings, 'camera', None) is None:
            continue
        topic = f'{team}/{robot}/camera/image_raw'
        displays.append(_camera(f'Camera of {robot}', topic, shown=True))
        # Topic in a bag.
        displays.append(_camera(f'Camera of {robot}, bag', f'{topic}/compressed', shown=False))
    return yaml.safe_dump(content, sort_keys=False)


def shown_topics(path: Path) -> list[str]:
    """Return the topics that an RViz configuration shows, and those of frames."""
    content = yaml.safe_load(path.read_text(encoding='utf-8'))
    displays = content['Visualization Manager']['Displays']
    topics = [display['Topic']['Value'] for display in displays if 'Topic' in display]
    return [*topics, '/tf', '/tf_static']


def _camera(name: str, topic: str, *, shown: bool) -> dict[str, Any]:
    return {
        'Class': 'rviz_default_plugins/Image',
        'Enabled': shown,
        'Name': name,
        'Normalize Range': False,
        'Topic': {
            'Durability Policy': 'Volatile',
            'Reliability Policy': 'Best Effort',
            'Value': topic,
        },
        'Value': shown,
    }

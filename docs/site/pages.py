"""Writes the pages of the documentation site: those of docs/, and a generated reference.

Run by ./scripts/docs: pages.py FOLDER.
"""

from __future__ import annotations

import importlib
import os
import re
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path

from page_tables import code, table

from maasi_filter.ros.parameters import parameters_of, written

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / 'docs'
# What each part of the site holds, in order, under its title and what it is for; a page of docs/
# that is in no part goes to the last.
PARTS = {
    'tutorials': (
        'Tutorials',
        'Learn: complete examples, from the first search to real robots.',
        [
            'first_search',
            *(
                f'tutorials/{name}'
                for name in ('student', 'area', 'ros_engineer', 'field', 'researcher')
            ),
        ],
    ),
    'how_to': (
        'How-to',
        'Do: one task each, with the commands or the code.',
        [
            'install',
            *(f'how_to/{name}' for name in ('search_area', 'map_files', 'keep_outs', 'terrain')),
            'how_to/people',
            'how_to/batteries',
            *(
                f'how_to/{name}'
                for name in ('robot', 'autopilots', 'detections', 'planner', 'filter')
            ),
            *('plugins', 'how_to/other_systems', 'how_to/bags', 'compare', 'view'),
            *('robots', 'robots_mavlink', 'robots_mambo'),
        ],
    ),
    'reference': (
        'Reference',
        'Look up: keys, commands, topics, parameters, fields, classes.',
        [
            *('scenario_keys', 'commands', 'nodes'),
            *(f'reference/{name}' for name in ('parameters', 'messages')),
            *('report', 'parameters', 'messages', 'measurement_feed', 'filter_presets', 'api/api'),
        ],
    ),
    'background': (
        'Background',
        'Understand: methods, guarantees, and how well it works.',
        [
            *('words_search_and_rescue', 'words_tracking', 'architecture', 'filter', 'planners'),
            *('cuboid_mpc', 'reliability', 'repeatability', 'search_quality', 'filter_quality'),
            *('judge', 'reproduction', 'claims'),
        ],
    ),
}
LAST = 'background'
# Outside of docs/.
SHOWN = (Path('README.md'), Path('CONTRIBUTING.md'))
PICTURES = ('.png', '.gif')
NODES = [
    ('maasi_filter', 'filter_node', 'FilterNode'),
    ('maasi_planner', 'planner_node', 'PlannerNode'),
    ('maasi_planner', 'buildings.cuboid_planner_node', 'CuboidPlannerNode'),
    ('maasi_drivers', 'agent.agent_driver', 'AgentDriver'),
    ('maasi_drivers', 'guard_node', 'GuardNode'),
    ('maasi_sim', 'simulation.sim_node', 'SimNode'),
    ('maasi_sim', 'run.buildings.cuboid_sim_node', 'CuboidSimNode'),
]
HOME = """# MAASI: multi-robot search for targets

Plan and run team searches: drones and ground robots find an unknown number of targets in your area.

![Two drones and a rover search a valley](field.gif)

DOORS

Two commands in a clone, without any ROS ([what they need](README.md#try-it)). Two simulated robots
find twelve markers, shown on a page:

```sh
./scripts/demo --view
```

All tests:

```sh
./scripts/test
```

"""


def site_text(text: str, page: Path) -> str:
    """Return a page of the repository with links as the site has them."""

    def change(match: re.Match[str]) -> str:
        mark, words, target = match.groups()
        name, hash_, anchor = target.partition('#')
        if not name or re.match(r'\w+:', target):
            return match.group()
        path = Path(os.path.normpath(page.parent / name)).relative_to(ROOT)
        source = page.relative_to(ROOT)
        is_page = path in SHOWN or (path.parts[0] == 'docs' and path.suffix in ('.md', *PICTURES))
        if not is_page:
            # Not a page of the site.
            shown = words.strip('`')
            return f'`{path}`' if shown in (name, str(path)) else f'{words} (`{path}`)'
        here, there = (
            Path(*item.parts[1:]) if item.parts[0] == 'docs' else item for item in (source, path)
        )
        return f'{mark}[{words}]({os.path.relpath(there, here.parent)}{hash_}{anchor})'

    # Badges would need the network.
    text = re.sub(r'^\[!\[.*\n', '', text, flags=re.MULTILINE)
    text = re.sub(r'(!?)\[([^\]]*)\]\(([^)\s]+)\)', change, text)
    # A library that draws diagrams would need the network: they are shown as they are written.
    return text.replace('```mermaid', '```text')


def pages() -> list[Path]:
    """Return the pages of the repository that the site has."""
    found = [path for path in DOCS.rglob('*.md') if path.parent.name != 'site']
    return [*(ROOT / path for path in SHOWN), *sorted(found)]


def copy_pages(target: Path) -> None:
    for page in pages():
        place = target / (page.relative_to(DOCS) if DOCS in page.parents else page.name)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(site_text(page.read_text(), page))
    for picture in (path for path in DOCS.rglob('*') if path.suffix in PICTURES):
        place = target / picture.relative_to(DOCS)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(picture, place)


def doors() -> str:
    """Return links to the four kinds of documents."""
    links = [
        f'<a href="{name}.html"><strong>{title}</strong> {text}</a>'
        for name, (title, text, _) in PARTS.items()
    ]
    return '\n'.join(['<div class="doors">', *links, '</div>'])


def contents(names: Iterable[str], options: str = '') -> str:
    return '\n'.join(['```{toctree}', ':maxdepth: 1', options, *names, '```', ''])


def write_contents(target: Path, names: set[str]) -> None:
    """Write the first page and that of each part of the site."""
    listed = {name for _, _, part in PARTS.values() for name in part}
    rest = sorted(names - listed - {str(path.with_suffix('')) for path in SHOWN})
    for name, (title, text, part) in PARTS.items():
        rows = [page for page in part if page in names] + (rest if name == LAST else [])
        (target / f'{name}.md').write_text(f'# {title}\n\n{text}\n\n{contents(rows)}')
    shown = [*PARTS, 'About <README>', 'CONTRIBUTING']
    first = HOME.replace('DOORS', doors())
    (target / 'index.md').write_text(first + contents(shown, ':hidden:'))


def parameters_page() -> str:
    text = [
        '# Parameters of the nodes\n',
        'How they are set, and which can be changed while a node runs: '
        '[parameters](../parameters.md). NAME stands for the name of a robot.\n',
    ]
    for package, module, name in NODES:
        node = getattr(importlib.import_module(f'{package}.{module}'), name)
        title = 'drivers' if name == 'AgentDriver' else module.rpartition('.')[2]
        rows = [
            (
                code(item.name),
                item.constraints,
                '' if item.default is None else code(written(item.default)),
                item.info.description,
            )
            for item in parameters_of(node)
        ]
        text += [
            f'## {title}\n',
            f'Package `{package}`.\n',
            table(('parameter', 'allowed', 'default', 'meaning [unit]'), rows),
        ]
    return '\n'.join(text)


def messages_page() -> str:
    text = [
        '# Messages and actions\n',
        'Of the package `maasi_msgs`, with the unit of each field.\n',
    ]
    for kind in ('msg', 'action', 'srv'):
        for file in sorted((ROOT / 'maasi_msgs' / kind).glob(f'*.{kind}')):
            text.append(f'## {file.stem}\n\n```text\n{file.read_text().strip()}\n```\n')
    return '\n'.join(text)


REFERENCE = {
    'parameters': parameters_page,
    'messages': messages_page,
}


def main() -> None:
    target = Path(sys.argv[1])
    copy_pages(target)
    (target / 'reference').mkdir(exist_ok=True)
    for name, make in REFERENCE.items():
        (target / 'reference' / f'{name}.md').write_text(make())
    names = {path.relative_to(target).with_suffix('').as_posix() for path in target.rglob('*.md')}
    if (target / 'api').is_dir():
        names.add('api/api')
    write_contents(target, names)


if __name__ == '__main__':
    main()

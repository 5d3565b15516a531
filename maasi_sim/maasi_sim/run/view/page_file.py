"""The page of a run as one HTML file: without a run for live views, or with a run inside."""

import contextlib
import json
import os
import re
import sys
import webbrowser
from functools import cache
from pathlib import Path

from maasi_filter import colours
from maasi_sim.run.run_folder import write_text
from maasi_sim.run.view.event_log import LARGEST, EventLog

FOLDER = Path(__file__).with_name('page')
REPLAY = 'replay.html'
# Each file uses only earlier ones.
_MODULES = (
    'run_log camera colours text icons words shapes labels floor_grid unexplored belief robots '
    'buildings map_frame statements map why panels pictures legend marks strips earth tips curve '
    'live drawing reports main'
)


def empty_page() -> str:
    """Return the page without a run, which loads it from its server."""
    return _with('RUN', _page(), '')


def write_replay(log: EventLog, path: Path, largest: int = LARGEST) -> None:
    """Write the page with a run inside, thinned to a size [characters]."""
    write_text(path, _with('RUN', _page(), log.packed(largest)))


@cache
def _page() -> str:
    names = ('index.html', 'page.css', *(f'{name}.js' for name in _MODULES.split()))
    text, style, *modules = ((FOLDER / name).read_text(encoding='utf-8') for name in names)
    # In one scope, without imports.
    script = re.sub(r'^(import .*;\n|export )', '', '\n'.join(modules), flags=re.MULTILINE)
    named = {name: value for name, value in vars(colours).items() if name.isupper()}
    shared = (f'const {name} = {json.dumps(value)};\n' for name, value in named.items())
    return _with('SCRIPT', _with('STYLE', text, style), ''.join(shared) + script)


def _with(place: str, text: str, content: str) -> str:
    before, mark, after = text.partition(f'/*{place}*/')
    assert mark, place
    return before + content + after


def open_browser(address: str) -> bool:
    """Open an address in a browser; return whether there is one with a display."""
    if sys.platform.startswith('linux') and not (
        os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')
    ):
        return False
    with contextlib.suppress(webbrowser.Error, OSError):
        return webbrowser.open(address)
    return False

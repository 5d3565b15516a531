"""Makes the pictures of the documents: searches, their pages in Chromium, a video.

./scripts/python docs/site/pictures.py [NAME ...], in some minutes; needs Chromium.
"""

from __future__ import annotations

import contextlib
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

from maasi_filter.colours import FOUND, KEEP_OUT, POTENTIAL, ROBOTS, SEEN
from maasi_sim.run.report_panels import UNSEEN
from maasi_sim.run.view.recording import event_log
from maasi_sim.run.view.video import GIF_RATE, RATE, write_video
from maasi_sim.scenario import load_scenario
from maasi_sim.search import search
from maasi_sim.search_result import SearchResult

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / 'docs'
sys.path.append(str(ROOT / 'test'))


class Picture(NamedTuple):
    """The page of a search at a time."""

    scenario: str  # name, file, or document with it as its first such block
    time: float  # [s]
    robot: str = ''  # whose decision is shown
    seed: int = 1


PICTURES = {
    'view': Picture('mambo_turtlebot', 25.0, 'mambo'),
    'field': Picture('field', 75.0, 'east'),
    'batteries': Picture('field_batteries', 72.0, 'drone'),
    'my_area': Picture('docs/tutorials/area.md', 600.0),
    'garden': Picture('docs/tutorials/student.md', 15.0, 'drone'),
    'field_team': Picture('examples/field_team/search.yaml', 10.0, 'drone'),
}
VIDEO = 'field.gif'
SPEED = 32.0  # of the video
SIZE = 640, 480  # of its frames [px]
LAST = 2000  # time of the last frame [ms]
LARGEST = 2_000_000  # bytes of the video


def searched(picture: Picture, folder: Path) -> SearchResult:
    name = picture.scenario
    if name.endswith('.md'):
        (text, *_) = re.findall(r'```yaml\n(version.*?)```', (ROOT / name).read_text(), re.DOTALL)
        file = folder / 'search.yaml'
        file.write_text(text)
        name = str(file)
    elif '/' in name:
        name = str(ROOT / name)
    return search(load_scenario(name), picture.seed)


@contextlib.contextmanager
def browser() -> Iterator[Any]:
    """Yield a page of the size of the pictures."""
    from browsers import chromium

    with chromium(1280, 720) as shown:
        yield shown


def main(names: list[str]) -> None:
    chosen = names or [*PICTURES, VIDEO]
    with tempfile.TemporaryDirectory() as made, browser() as shown:
        for name in chosen:
            if name == VIDEO:
                continue
            picture = PICTURES[name]
            stem = Path(picture.scenario).stem if 'mambo' in picture.scenario else name
            replay = Path(made) / f'{stem}.html'
            searched(picture, Path(made)).save_replay(replay)
            shown.open(replay.as_uri())
            shown.seek(picture.time)
            if picture.robot:
                shown.page.evaluate(f'maasi.select({picture.robot!r})')
            # Its headline changes once a second.
            shown.page.wait_for_timeout(1500)
            shown.page.screenshot(path=DOCS / f'{name}.png')
            print(DOCS / f'{name}.png')
    if VIDEO in chosen:
        write_animation(DOCS / VIDEO)


def palette() -> Image.Image:
    """Return an image whose colours are those of a video, and what lies between them and white."""
    drawn = [to_rgb(one) for one in (*ROBOTS[:3], FOUND, POTENTIAL, SEEN, KEEP_OUT, UNSEEN)]
    colours = [np.full(3, grey) for grey in np.linspace(0.0, 1.0, 9)]
    for colour in drawn:
        colours += [share * np.array(colour) + 1.0 - share for share in (1.0, 0.6, 0.25)]
        colours.append(0.5 * np.add(colour, to_rgb(UNSEEN)))
    image = Image.new('P', (1, 1))
    image.putpalette(np.round(255.0 * np.array(colours)).astype(int).ravel().tolist())
    return image


def write_animation(file: Path) -> None:
    """Write the video of `field` as a GIF with few colours."""
    frames, colours = [], palette()
    with tempfile.TemporaryDirectory() as made:
        video = Path(made) / 'field.mp4'
        write_video(event_log(search(load_scenario('field'), 1), 'field'), video, SPEED)
        reader = cv2.VideoCapture(str(video))
        while True:
            more, frame = reader.read()
            if not more:
                break
            image = Image.fromarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)).resize(SIZE)
            # Dithering would change every pixel of every frame.
            frames.append(image.quantize(palette=colours, dither=Image.Dither.NONE))
    first, *rest = frames[:: RATE // GIF_RATE]
    times = [1000 // GIF_RATE] * len(rest) + [LAST]
    first.save(file, save_all=True, append_images=rest, duration=times, loop=0, optimize=True)
    size = file.stat().st_size
    print(file, size)
    assert size <= LARGEST, f'read {size} bytes, allowed are {LARGEST}: raise SPEED'


if __name__ == '__main__':
    main(sys.argv[1:])

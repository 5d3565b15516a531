"""Renders the events of a run as a video, without a browser."""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.path import Path as Outline
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray, ImageArray
from maasi_filter.colours import (
    AWAY,
    FOUND,
    KEEP_OUT,
    OPEN,
    POTENTIAL,
    SEEN,
    VISITED,
    robot_colours,
)
from maasi_sim.run.buildings.picture import OBJECT, OBSTACLE, draw_box
from maasi_sim.run.report_panels import PALE, UNSEEN
from maasi_sim.run.run_folder import write_whole
from maasi_sim.run.view.event_log import Event, EventLog, Scene, shares
from maasi_sim.run.view.event_maker import LEFT, MOVING, SILENT, UNAVAILABLE

Progress = Callable[[float], object]  # receives the completed share
# Pictures per second, low for GIFs. Size [in] at a resolution [px/in].
RATE, GIF_RATE = 30, 10
_SIZE, _RESOLUTION = (9.6, 7.2), 80
_HOLD = 2.0  # duration of the last picture [s]
_FADE = 1.0  # display time of detections [s]
# Most points of a path, and points of a circle.
_MOST_POINTS = 600
_CIRCLE = np.stack([f(np.linspace(0.0, 2.0 * np.pi, 40)) for f in (np.cos, np.sin)], axis=1)
_SOLID = '#59636E'
# Legend: layer, text, mark and colour.
_LEGEND = (
    ('', 'left or unavailable', '>', AWAY),
    ('', 'planned path', '--', PALE),
    ('targets', 'waypoint', 's', PALE),
    ('floor', 'field of view', ':', PALE),
    ('floor', 'not explored', 's', UNSEEN),
    ('targets', 'found, 3 sigma', 'o', FOUND),
    ('targets', 'potential, 2 sigma', 'o', POTENTIAL),
    ('targets', 'detection', '+', SEEN),
    ('targets', 'true target', 'x', '0.2'),
    ('obstacles', 'obstacle', 'o', _SOLID),
    ('keep_outs', 'keep-out', 's', KEEP_OUT),
    ('fence', 'geofence', '-.', PALE),
    ('cuboids', 'cuboid to visit', 's', OPEN),
    ('cuboids', 'cuboid visited', 's', VISITED),
    ('cuboids', 'building', 's', OBJECT),
    ('cuboids', 'radio link', ':', '0.3'),
)


class Moments:
    """State of the run at a time that only increases: last event of each kind and owner, paths."""

    def __init__(self, log: EventLog) -> None:
        self.scene: Scene = log.scene
        self.time = 0.0
        #: Last event by kind, then by owner; detections of the last moments.
        self.last: dict[str, dict[str, Event]] = defaultdict(dict)
        self.seen: list[Event] = []
        #: By robot: path so far, tour, and waypoint (None: it stays).
        self.paths: dict[str, list[list[float]]] = defaultdict(list)
        self.tours: dict[str, list[list[float]]] = {}
        self.waypoints: dict[str, list[float] | None] = {}
        #: Cuboids visited.
        self.visited: set[int] = set()
        moving = {event[2] for event in log.events if event[1] == 'robot'}
        self.robots = sorted(moving | set(self.scene.get('robots', {})))
        # The next event is the last of the list.
        self._coming = sorted(log.events, key=lambda event: float(event[0]))[::-1]

    def advance(self, time: float) -> None:
        """Apply the events up to a time."""
        self.time = time
        while self._coming and self._coming[-1][0] <= time:
            event = self._coming.pop()
            _, kind, owner, *content = event
            self.last[kind][owner] = event
            if kind == 'robot':
                self.paths[owner].append(content[0][:3])
            elif kind == 'seen':
                self.seen.append(event)
            elif kind == 'plan':
                for name, _, chosen, waypoint, _, _, *tour in content[4]:
                    self.waypoints[name] = waypoint if chosen >= 0 else None
                    self.tours[name] = [waypoint, *chain(*tour)]
            elif kind == 'cuboid':
                self.visited |= {shot[0] for shot in content[5]}
        self.seen = [event for event in self.seen if event[0] >= time - _FADE]

    def title(self) -> str:
        """Return name and time of the run, and what was found."""
        found, total = len(self.visited), len(self.scene.get('cuboids', []))
        word = 'visited' if total else 'found'
        if not total:
            found = sum(len(event[3]) for event in self.last['found'].values())
            total = self.scene.get('targets', 0)
        of = f' of {total}' if total else ''
        return f'{self.scene.get("name", "")}   {self.time:.1f} s   {word} {found}{of}'


def write_video(log: EventLog, path: Path, speed: float = 5.0, progress: Progress = float) -> None:
    """Write a run as FILE.mp4 or FILE.gif, at `speed` times real time."""
    write, rate = (_write_gif, GIF_RATE) if path.suffix == '.gif' else (_write_mp4, RATE)
    pictures = _pictures(log, speed, rate, progress)
    # Keep the suffix, which determines the file type.
    write_whole(path, lambda part: write(part, pictures))


def _write_mp4(path: Path, pictures: Iterator[ImageArray]) -> None:
    size = round(_SIZE[0] * _RESOLUTION), round(_SIZE[1] * _RESOLUTION)
    writer: Any = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*'mp4v'), RATE, size)
    try:
        if not writer.isOpened():
            raise OSError(f'{path}: cannot write a video')
        # Encode in parallel to drawing.
        with ThreadPoolExecutor(1) as encoder:
            done: Future[Any] = encoder.submit(int)
            for picture in pictures:
                turned = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
                done.result()
                done = encoder.submit(writer.write, turned)
    finally:
        writer.release()


def _write_gif(path: Path, pictures: Iterator[ImageArray]) -> None:
    from PIL import Image

    first, *rest = (
        Image.fromarray(item).quantize(64, Image.Quantize.MEDIANCUT) for item in pictures
    )
    every: Any = {'duration': 1000 // GIF_RATE, 'loop': 0, 'optimize': True}
    first.save(path, save_all=True, append_images=rest, **every)


def _pictures(log: EventLog, speed: float, rate: int, progress: Progress) -> Iterator[ImageArray]:
    now = Moments(log)
    places = [event[3][:2] for event in log.events if event[1] == 'robot'] or [[0, 0], [1, 1]]
    extent = [np.min(places, axis=0) - 1.0, np.max(places, axis=0) + 1.0]
    sheet = Sheet(np.array(log.scene.get('bounds') or np.transpose(extent)), now)
    duration = log.duration
    count = max(1, math.ceil(duration / speed * rate)) + 1
    for index in range(count):
        now.advance(min(index * speed / rate, duration))
        picture = sheet.draw(now)
        yield picture
        progress((index + 1) / count)
    for _ in range(round(_HOLD * rate)):
        yield picture


class Sheet:
    """Axes on which a run is drawn: moving parts on a cached ground."""

    def __init__(self, bounds: FloatArray, now: Moments) -> None:
        self.bounds = bounds
        self.size = size = len(bounds)
        self._robots: dict[str, Any] = now.scene.get('robots', {})
        self._colours = robot_colours(now.robots)
        figure = Figure(figsize=_SIZE, dpi=_RESOLUTION, layout='constrained')
        self._canvas = FigureCanvasAgg(figure)
        axes: Any = figure.add_subplot(projection='3d' if size == 3 else None)
        for name, limits in zip('xyz', bounds):
            axes.set(**{f'{name}lim': limits, f'{name}label': f'{name} [m]'})
        if size == 3:
            # Space for the axis labels.
            axes.set_box_aspect(np.ptp(bounds, axis=1), zoom=0.9)
        else:
            axes.set_aspect('equal')
        self._axes = axes
        self._add_legend(now.scene)
        self._title = axes.set_title(now.title(), animated=True)
        # Reusable artists by kind; number in use by kind; artists to draw.
        self._pool: dict[str, list[Any]] = defaultdict(list)
        self._used: Counter[str] = Counter()
        self._drawn: list[Any] = []
        # Drawn once: axes and legend. On top the ground and what it shows.
        self._canvas.draw()
        self._axes_alone = self._ground = self._canvas.copy_from_bbox(figure.bbox)
        self._shown: list[Any] = []

    def draw(self, now: Moments) -> ImageArray:
        """Return the picture (height, width, 3), valid until the next call."""
        kinds = (now.last[kind].values() for kind in ('map', 'truth', 'found'))
        shown = [len(now.visited), *chain.from_iterable(kinds)]
        if shown != self._shown:
            self._shown = shown
            (self._draw_boxes if self.size == 3 else self._draw_floor)(now)
            self._draw_known(now)
            self._flush(self._axes_alone)
            self._ground = self._canvas.copy_from_bbox(self._canvas.figure.bbox)
        self._title.set_text(now.title())
        self._drawn.append(self._title)
        self._draw_expected(now)
        for name, colour in self._colours.items():
            if name in now.last['robot']:
                self._draw_robot(now, name, colour)
        self._flush(self._ground)
        return np.asarray(self._canvas.buffer_rgba())[:, :, :3]

    def _flush(self, ground: Any) -> None:
        """Draw the queued artists on a ground; in 3D solid parts from back to front."""
        self._canvas.restore_region(ground)
        self._drawn.sort(key=lambda item: -getattr(item, 'do_3d_projection', lambda: -math.inf)())
        for artist in self._drawn:
            self._axes.draw_artist(artist)
        self._drawn.clear()
        self._used.clear()

    def _next(self, kind: str, make: Callable[[], Any]) -> Any:
        pool, number = self._pool[kind], self._used[kind]
        if number == len(pool):
            pool.append(make())
        self._used[kind] += 1
        self._drawn.append(pool[number])
        return pool[number]

    def _line(self, places: ArrayLike, style: str, **options: Any) -> None:
        points = np.asarray(places, dtype=float)
        points = points.reshape(-1, points.shape[-1] if points.ndim > 1 else 3)[:, : self.size].T
        line = self._next(style, lambda: self._axes.plot(*points, style)[0])
        (line.set_data_3d if self.size == 3 else line.set_data)(*points)
        line.set(**{'alpha': 1.0, 'mfc': options['color'], **options})

    def _text(self, place: list[float], text: str, **options: Any) -> None:
        label = self._next('text', lambda: self._axes.text(*place[: self.size], text))
        (label.set_position_3d if self.size == 3 else label.set_position)(place[: self.size])
        label.set(text=text, **options)

    def _mark(self, row: list[float], deviations: float, **style: Any) -> None:
        x, y, z, xx, xy, _, yy, *_ = row
        self._line([x, y, z], 'o', ms=4, **style)
        if self.size == 2:
            # Square root of the covariance by Cholesky.
            first = math.sqrt(max(xx, 1e-12))
            other = math.sqrt(max(yy - (xy / first) ** 2, 0.0))
            ring = _CIRCLE @ np.array([[first, xy / first], [0.0, other]])
            self._line((x, y) + deviations * ring, '-', lw=1.0, **style)

    def _draw_floor(self, now: Moments) -> None:
        for event in list(now.last['map'].values())[:1]:
            (x, y, _), (dx, dy, _), (nx, ny, _), digits = event[3:7]
            values = np.maximum(shares(digits), 0.0).reshape(nx, ny).T
            extent = (x - dx / 2, x + (nx - 0.5) * dx, y - dy / 2, y + (ny - 0.5) * dy)
            shades: Any = {'origin': 'lower', 'cmap': 'Greys', 'vmin': 0, 'vmax': 2.7}
            # Draw the frame again over the map.
            image = self._axes.imshow(values, extent=extent, **shades)
            self._drawn += [image, *self._axes.spines.values()]
        changed = now.last['zones'].get('')
        for zone in changed[3] if changed else now.scene.get('zones', []):
            colour = {'area': '0.1', 'keep_out': KEEP_OUT, 'obstacle': _SOLID}[zone['kind']]
            for ring in zone['rings']:
                self._line(np.array(ring), '-', color=colour, lw=1.2)
        kept = max((robot.get('clearance', 0.0) for robot in self._robots.values()), default=0.0)
        for *centre, radius in now.scene.get('obstacles', []):
            self._drawn.append(self._axes.add_patch(Circle(centre[:2], radius, color=_SOLID)))
            self._line(centre[:2] + (radius + kept) * _CIRCLE, '--', color=_SOLID, lw=1.0)

    def _draw_boxes(self, now: Moments) -> None:
        for key, colour, alpha in (('objects', OBJECT, 0.35), ('blocks', OBSTACLE, 0.6)):
            for box in now.scene.get(key, []):
                self._box(box, colour, alpha)
        for number, box in enumerate(now.scene.get('cuboids', [])):
            self._box(box, *((VISITED, 0.12) if number in now.visited else (OPEN, 0.35)))

    def _box(self, box: list[list[float]], colour: str, alpha: float) -> None:
        sides = np.array(box)
        self._next(f'{box} {alpha}', lambda: draw_box(self._axes, sides, colour, alpha, ''))

    def _draw_known(self, now: Moments) -> None:
        for name, colour in self._colours.items():
            fence = self._robots.get(name, {}).get('fence')
            if fence and self.size == 3:
                self._box(fence, colour, 0.05)
            elif fence:
                box = _outline(*np.transpose(fence[:2]))
                self._line(box, '-.', color=colour, lw=0.9, alpha=0.7)
        for event in now.last['truth'].values():
            self._line(event[3], 'x', color='0.2', ms=6)
        for event in now.last['found'].values():
            for number, x, y, z, covariance, *_ in event[3]:
                self._mark([x, y, z, *covariance], 3.0, color=FOUND)
                self._text([x, y, z], f'  {number}', fontsize=8, weight='normal')

    def _draw_expected(self, now: Moments) -> None:
        for event in now.last['filter'].values():
            for x, y, z, mass, *covariance in event[4]:
                style: Any = {'color': POTENTIAL, 'alpha': min(0.3 + mass, 1.0)}
                self._mark([x, y, z, *covariance], 2.0, **style)
        for *_, place, detections in now.seen:
            for reach, bearing, elevation, *_ in detections:
                level = math.cos(elevation)
                ray = level * math.cos(bearing), level * math.sin(bearing), math.sin(elevation)
                self._line(np.add(place, np.multiply(reach, ray)), '+', color=SEEN, ms=6)
        places = {name: path[-1] for name, path in now.paths.items()}
        for name, event in now.last['cuboid'].items():
            for other in places.keys() & {*event[6]} if name in places else ():
                self._line([places[name], places[other]], ':', color='0.3', lw=1.0)

    def _draw_robot(self, now: Moments, name: str, colour: str) -> None:
        size, robot = self.size, self._robots.get(name, {})
        (*place, yaw), _, status = now.last['robot'][name][3:6]
        away = status in (UNAVAILABLE, LEFT, SILENT)
        if status != LEFT:
            path = now.paths[name]
            path = [*path[:: math.ceil(len(path) / _MOST_POINTS)], path[-1]]
            self._line(path, '-', color=colour, lw=1.3)
        colour = AWAY if away else colour
        if status == MOVING:
            self._line(now.last['way'].get(name, [[]])[-1], '--', color=colour, lw=1.3)
            self._line(now.waypoints.get(name) or [], 's', color=colour, ms=8, mfc='none')
            self._line(now.tours.get(name, []), '--', color=colour, lw=0.6)
        if size == 3 and not away:
            # Height.
            foot = [*place[:2], self.bounds[2, 0]]
            self._line([foot, place], ':', color=colour, lw=0.8)
        elif 'view' in robot and not away:
            outline = _view(robot['view'], place, yaw)
            view = self._next('view', lambda: self._axes.fill(*outline.T, ls=':')[0])
            view.set(xy=outline, ec=colour, fc=(*to_rgb(colour), 0.12))
        # Seen from above it points ahead.
        arrow = [[1.4, 0.0], [-0.9, 0.8], [-0.5, 0.0], [-0.9, -0.8], [1.4, 0.0]]
        marker: Any = 'D' if size == 3 else Outline(arrow @ _turn(yaw))
        self._line(place, '', marker=marker, color=colour, ms=8 if size == 3 else 16)
        label = f'   {name}' + (' (left)' if status == LEFT else '')
        self._text(place, label, fontsize=9, weight='bold')

    def _add_legend(self, scene: Scene) -> None:
        kinds = {'', 'cuboids' if scene.get('cuboids') else 'targets'}
        if self.size == 2:
            kinds |= {'floor', 'obstacles' if scene.get('obstacles') else ''}
            kinds |= {f'{zone["kind"]}s' for zone in scene.get('zones', [])}
        if any('fence' in robot for robot in self._robots.values()):
            kinds.add('fence')
        robots = [('', name, '>-', colour) for name, colour in self._colours.items()]
        for kind, text, style, colour in (*robots, *_LEGEND):
            if kind in kinds:
                face = 'none' if text == 'waypoint' else colour
                ends = np.zeros((self.size, 0))
                self._axes.plot(*ends, style, color=colour, label=text, ms=8, mfc=face)
        self._axes.figure.legend(loc='outside right upper', frameon=False, fontsize=9)


def _turn(yaw: float) -> FloatArray:
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, sin], [-sin, cos]])


def _view(view: dict[str, Any], place: list[float], yaw: float) -> FloatArray:
    if view['kind'] != 'box':
        return np.asarray(_CIRCLE * view['size'][:2] + place[:2])
    corners = _outline(*np.array([view['lower'][:2], view['upper'][:2]]))
    return np.asarray(corners @ _turn(yaw if view['turns'] else 0.0) + place[:2])


def _outline(lower: FloatArray, upper: FloatArray) -> FloatArray:
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    return np.asarray(lower + corners * (upper - lower))

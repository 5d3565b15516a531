"""Renders the events of a run as a video, without a browser."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Polygon, Rectangle
from matplotlib.path import Path as Outline
from numpy.typing import ArrayLike, NDArray

from maasi_filter.colours import AWAY, FOUND, POTENTIAL, SEEN, robot_colours
from maasi_sim.run.buildings.picture import OBJECT, OBSTACLE, OPEN, VISITED, draw_box
from maasi_sim.run.report_panels import ellipse
from maasi_sim.run.run_folder import write_whole
from maasi_sim.run.view.event_log import Event, EventLog, Scene
from maasi_sim.run.view.event_maker import LEFT, MOVING, SILENT, UNAVAILABLE

# Pictures per second, and size [in] at a resolution [px/in].
RATE = 10
_SIZE, _RESOLUTION = (9.6, 7.2), 80
# The last picture is shown for so long [s].
_HOLD = 2.0
# Detections are shown for so long [s].
_FADE = 1.0


class Moments:
    """What holds at a time, which only rises: the last event of each kind and owner, and ways."""

    def __init__(self, log: EventLog) -> None:
        self.scene: Scene = log.scene
        self.time = 0.0
        #: Last event by kind, then by owner; detections of the last moments.
        self.last: dict[str, dict[str, Event]] = defaultdict(dict)
        self.seen: list[Event] = []
        #: By robot: its way so far, and where it is sent, None: it stays.
        self.ways: dict[str, list[list[float]]] = defaultdict(list)
        self.waypoints: dict[str, list[float] | None] = {}
        #: Cuboids visited.
        self.visited: set[int] = set()
        moving = {event[2] for event in log.events if event[1] == 'robot'}
        self.robots = sorted(moving | set(self.scene.get('robots', {})))
        # The next one is the last of the list.
        self._coming = sorted(log.events, key=lambda event: float(event[0]))[::-1]

    def advance(self, time: float) -> None:
        """Take the events until a time."""
        self.time = time
        while self._coming and self._coming[-1][0] <= time:
            event = self._coming.pop()
            _, kind, owner, *content = event
            self.last[kind][owner] = event
            if kind == 'robot':
                self.ways[owner].append(content[0][:3])
            elif kind == 'seen':
                self.seen.append(event)
            elif kind == 'plan':
                for name, _, chosen, waypoint, *_ in content[4]:
                    self.waypoints[name] = waypoint if chosen >= 0 else None
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


def write_video(log: EventLog, path: Path, speed: float = 5.0) -> None:
    """Write a run as FILE.mp4 or FILE.gif, `speed` times as fast."""
    pictures = _pictures(log, speed)
    write = _write_gif if path.suffix == '.gif' else _write_mp4
    # Keep the suffix: it tells the type of the file.
    write_whole(path, lambda part: write(part, pictures))


def _write_mp4(path: Path, pictures: Iterator[NDArray[np.uint8]]) -> None:
    import cv2

    first = next(pictures)
    height, width = first.shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*'mp4v'), RATE, (width, height))
    try:
        if not writer.isOpened():
            raise OSError(f'{path}: cannot be written as a video')
        writer.write(np.ascontiguousarray(first[:, :, ::-1]))
        for picture in pictures:
            writer.write(np.ascontiguousarray(picture[:, :, ::-1]))
    finally:
        writer.release()


def _write_gif(path: Path, pictures: Iterator[NDArray[np.uint8]]) -> None:
    from PIL import Image

    frames = [Image.fromarray(item).quantize(64, Image.Quantize.MEDIANCUT) for item in pictures]
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=1000 // RATE, loop=0, optimize=True
    )


def _pictures(log: EventLog, speed: float) -> Iterator[NDArray[np.uint8]]:
    """Yield pictures of the run, (height, width, 3)."""
    now = Moments(log)
    places = [event[3][:2] for event in log.events if event[1] == 'robot'] or [[0, 0], [1, 1]]
    extent = [np.min(places, axis=0) - 1.0, np.max(places, axis=0) + 1.0]
    bounds = np.array(log.scene.get('bounds') or np.transpose(extent))
    figure = Figure(figsize=_SIZE, dpi=_RESOLUTION, layout='constrained')
    canvas = FigureCanvasAgg(figure)
    picture = np.zeros((1, 1, 3), np.uint8)
    for index in range(max(1, math.ceil(log.duration / speed * RATE)) + 1):
        now.advance(min(index * speed / RATE, log.duration))
        figure.clear()
        _draw(figure.add_subplot(projection='3d' if len(bounds) == 3 else None), now, bounds)
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())[:, :, :3].copy()
        yield picture
    for _ in range(round(_HOLD * RATE)):
        yield picture


def _draw(axes: Any, now: Moments, bounds: NDArray[np.float64]) -> None:
    size = len(bounds)
    for name, limits in zip('xyz', bounds):
        axes.set(**{f'{name}lim': limits, f'{name}label': f'{name} [m]'})
    if size == 3:
        # Labels of the axes need room.
        axes.set_box_aspect(bounds[:, 1] - bounds[:, 0], zoom=0.9)
        _draw_boxes(axes, now)
    else:
        axes.set_aspect('equal')
        _draw_floor(axes, now)
    _draw_targets(axes, now, size)
    for name, colour in robot_colours(now.robots).items():
        if name in now.last['robot']:
            _draw_robot(axes, now, name, colour, bounds)
    axes.set_title(now.title())


def _plot(axes: Any, places: ArrayLike, size: int, style: str, **options: Any) -> None:
    """Draw places (n, 3) [m]; in the plane without their height."""
    axes.plot(*np.asarray(places, dtype=float).reshape(-1, 3)[:, :size].T, style, **options)


def _draw_floor(axes: Any, now: Moments) -> None:
    for event in list(now.last['map'].values())[:1]:
        (x, y, _), (dx, dy, _), (nx, ny, _), digits = event[3:7]
        values = np.frombuffer(digits.encode(), np.uint8).reshape(nx, ny).T - ord('0')
        extent = (x - dx / 2, x + (nx - 0.5) * dx, y - dy / 2, y + (ny - 0.5) * dy)
        axes.imshow(values, origin='lower', extent=extent, cmap='Greys', vmin=0, vmax=24)
    kept = max((robot.get('clearance', 0.0) for robot in now.scene['robots'].values()), default=0.0)
    for *centre, radius in now.scene.get('obstacles', []):
        axes.add_patch(Circle(centre[:2], radius, color='#59636e'))
        if kept:
            axes.add_patch(Circle(centre[:2], radius + kept, fill=False, ls='--', ec='#59636e'))


def _draw_boxes(axes: Any, now: Moments) -> None:
    """Draw buildings and cuboids, and lines between robots of which one hears the other."""
    for key, colour, alpha in (('objects', OBJECT, 0.35), ('blocks', OBSTACLE, 0.6)):
        for box in now.scene.get(key, []):
            draw_box(axes, np.array(box), colour, alpha, '')
    for number, box in enumerate(now.scene.get('cuboids', [])):
        style = (VISITED, 0.12) if number in now.visited else (OPEN, 0.35)
        draw_box(axes, np.array(box), *style, '')
    places = {name: way[-1] for name, way in now.ways.items()}
    for name, event in now.last['cuboid'].items():
        for other in event[6]:
            if name in places and other in places:
                _plot(axes, [places[name], places[other]], 3, ':', color='0.3', lw=1.0)


def _draw_targets(axes: Any, now: Moments, size: int) -> None:
    for event in now.last['truth'].values():
        _plot(axes, event[3], size, 'x', color='0.2', ms=6)
    for event in now.last['filter'].values():
        for x, y, z, mass, *covariance in event[4]:
            _mark(axes, (x, y, z)[:size], covariance, 2.0, POTENTIAL, min(0.3 + mass, 1.0))
    for event in now.last['found'].values():
        for number, x, y, z, covariance, *_ in event[3]:
            _mark(axes, (x, y, z)[:size], covariance, 3.0, FOUND, 1.0)
            axes.text(*(x, y, z)[:size], f'  {number}', fontsize=8)
    for *_, place, detections in now.seen:
        for reach, bearing, elevation, *_ in detections:
            level = math.cos(elevation)
            ray = level * math.cos(bearing), level * math.sin(bearing), math.sin(elevation)
            _plot(axes, np.add(place, np.multiply(reach, ray)), size, '+', color=SEEN, ms=6)


def _mark(
    axes: Any,
    place: tuple[float, ...],
    covariance: list[float],
    deviations: float,
    colour: str,
    alpha: float,
) -> None:
    """Draw a place; in the plane with the ellipse of its covariance."""
    axes.plot(*np.array(place)[:, None], 'o', color=colour, ms=4, alpha=alpha)
    if len(place) == 2:
        xx, xy, _, yy, *_ = covariance
        spread, style = np.array([[xx, xy], [xy, yy]]), {'color': colour, 'alpha': alpha}
        axes.add_patch(ellipse((place[0], place[1]), spread, deviations, 0.0, **style))


def _draw_robot(
    axes: Any, now: Moments, name: str, colour: str, bounds: NDArray[np.float64]
) -> None:
    size, robot = len(bounds), now.scene.get('robots', {}).get(name, {})
    (*place, yaw), _, status = now.last['robot'][name][3:6]
    away = status in (UNAVAILABLE, LEFT, SILENT)
    if status != LEFT:
        _plot(axes, now.ways[name], size, '-', color=colour, lw=1.3)
    colour = AWAY if away else colour
    if status == MOVING:
        _plot(axes, now.last['way'].get(name, [[]])[-1], size, '--', color=colour, lw=1.3)
        waypoint = now.waypoints.get(name) or []
        _plot(axes, waypoint, size, 's', color=colour, ms=8, mfc='none')
    if size == 3 and not away:
        # How high it is.
        x, y, z = place
        axes.plot([x, x], [y, y], [bounds[2, 0], z], ':', color=colour, lw=0.8)
    elif 'view' in robot and not away:
        axes.add_patch(_view(robot['view'], place, yaw, colour))
    # From above it points ahead.
    arrow = [[1.4, 0.0], [-0.9, 0.8], [-0.5, 0.0], [-0.9, -0.8], [1.4, 0.0]]
    marker: Any = 'D' if size == 3 else Outline(arrow @ _turn(yaw))
    _plot(axes, place, size, '', marker=marker, color=colour, ms=8 if size == 3 else 16)
    label = f'   {name}' + (' (left)' if status == LEFT else '')
    axes.text(*place[:size], label, fontsize=9, weight='bold')
    if 'fence' in robot:
        (left, right), (low, high), _ = robot['fence']
        if size == 3:
            draw_box(axes, np.array(robot['fence']), colour, 0.05, '')
        else:
            line: Any = {'fill': False, 'ec': colour, 'ls': '-.', 'lw': 0.9, 'alpha': 0.7}
            axes.add_patch(Rectangle((left, low), right - left, high - low, **line))


def _turn(yaw: float) -> NDArray[np.float64]:
    """Return what turns rows x, y by a yaw [rad]."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, sin], [-sin, cos]])


def _view(view: dict[str, Any], place: list[float], yaw: float, colour: str) -> Any:
    """Return the outline of a field of view from above."""
    style: Any = {'ec': colour, 'fc': (*to_rgb(colour), 0.12), 'ls': ':'}
    if view['kind'] != 'box':
        wide, high = view['size'][:2]
        return Ellipse((place[0], place[1]), 2.0 * wide, 2.0 * high, **style)
    (left, low), (right, high) = view['lower'][:2], view['upper'][:2]
    corners = np.array([[left, low], [right, low], [right, high], [left, high]])
    return Polygon(corners @ _turn(yaw if view['turns'] else 0.0) + place[:2], **style)

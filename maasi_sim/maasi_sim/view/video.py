"""Renders the events of a run as a video, without a browser."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Polygon
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from maasi_sim.buildings.picture import draw_box
from maasi_sim.run.run_folder import write_whole
from maasi_sim.view.event_log import Event, EventLog
from maasi_sim.view.event_maker import LEFT, MOVING, SILENT, UNAVAILABLE

# Pictures per second, and size [in] at a resolution [px/in].
RATE = 10
_SIZE, _RESOLUTION = (9.6, 7.2), 80
_FOUND, _POTENTIAL, _SEEN, _OPEN, _VISITED = '#009E73', '#E69F00', '#CC79A7', '#D55E00', '#56B4E9'
# Of robots, as on the page.
_ROBOTS = ('#0072B2', '#D55E00', '#8C564B', '#56B4E9', '#7F7F7F', '#CC79A7')
_NAMED = {'purple': '#7B3294', 'red': '#D62728', 'green': '#2CA02C', 'blue': '#0072B2'}
# The last picture is shown for so long [s].
_HOLD = 2.0
# Detections are shown for so long [s].
_FADE = 1.0


class Moments:
    """What holds at a time: the last event of each kind and owner."""

    def __init__(self, log: EventLog) -> None:
        self.log = log
        self._times: dict[tuple[str, str], list[float]] = {}
        self._events: dict[tuple[str, str], list[Event]] = {}
        self._waypoints: dict[str, tuple[list[float], list[list[float] | None]]] = {}
        for event in sorted(log.events, key=lambda item: float(item[0])):
            key = event[1], event[2]
            self._times.setdefault(key, []).append(event[0])
            self._events.setdefault(key, []).append(event)
            for row in event[7] if event[1] == 'plan' else []:
                times, waypoints = self._waypoints.setdefault(row[0], ([], []))
                times.append(event[0])
                waypoints.append(row[3] if row[2] >= 0 else None)

    def until(self, kind: str, owner: str, time: float) -> list[Event]:
        """Return the events of a kind and owner at or before a time."""
        key = kind, owner
        return self._events.get(key, [])[: bisect.bisect_right(self._times.get(key, []), time)]

    def now(self, kind: str, time: float) -> Iterator[Event]:
        """Yield the event of each owner that holds at a time."""
        for known, owner in sorted(self._times):
            if known == kind:
                events = self.until(kind, owner, time)
                if events:
                    yield events[-1]

    @property
    def robots(self) -> list[str]:
        """Names of all robots."""
        moving = {owner for kind, owner in self._times if kind == 'robot'}
        return sorted(moving | set(self.log.scene.get('robots', {})))

    def waypoint(self, robot: str, time: float) -> list[float] | None:
        """Return where a robot is sent at a time; None: it stays, or has not decided."""
        times, waypoints = self._waypoints.get(robot, ([], []))
        index = bisect.bisect_right(times, time)
        return waypoints[index - 1] if index else None

    def found(self, time: float) -> int:
        """Return how many targets or cuboids were found by a time."""
        if 'cuboids' in self.log.scene:
            return len(self.visited(time))
        return sum(len(event[3]) for event in self.now('found', time))

    def visited(self, time: float) -> set[int]:
        """Return the cuboids visited by a time."""
        owners = {owner for kind, owner in self._times if kind == 'cuboid'}
        return {
            shot[0]
            for owner in owners
            for event in self.until('cuboid', owner, time)
            for shot in event[8]
        }


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
    moments = Moments(log)
    figure = Figure(figsize=_SIZE, dpi=_RESOLUTION, layout='constrained')
    canvas = FigureCanvasAgg(figure)
    count = max(1, math.ceil(log.duration / speed * RATE)) + 1
    picture = np.zeros((1, 1, 3), np.uint8)
    for index in range(count):
        time = min(index * speed / RATE, log.duration)
        figure.clear()
        _draw(figure, moments, time)
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())[:, :, :3].copy()
        yield picture
    for _ in range(round(_HOLD * RATE)):
        yield picture


def _draw(figure: Figure, moments: Moments, time: float) -> None:
    scene = moments.log.scene
    bounds = np.array(scene.get('bounds') or _extent(moments.log))
    spatial = len(bounds) == 3
    axes: Any = figure.add_subplot(projection='3d' if spatial else None)
    axes.set_xlim(*bounds[0])
    axes.set_ylim(*bounds[1])
    axes.set_xlabel('x [m]')
    axes.set_ylabel('y [m]')
    if spatial:
        axes.set_zlim(*bounds[2])
        axes.set_zlabel('z [m]')
        # Labels of the axes need room.
        axes.set_box_aspect(bounds[:, 1] - bounds[:, 0], zoom=0.9)
        _draw_boxes(axes, moments, time)
        _draw_links(axes, moments, time)
    else:
        axes.set_aspect('equal')
        _draw_floor(axes, moments, time)
    _draw_targets(axes, moments, time, spatial)
    _draw_robots(axes, moments, time, spatial)
    total = len(scene['cuboids']) if 'cuboids' in scene else scene.get('targets')
    of = f' of {total}' if total else ''
    word = 'visited' if 'cuboids' in scene else 'found'
    axes.set_title(f'{scene.get("name", "")}   {time:.1f} s   {word} {moments.found(time)}{of}')


def _extent(log: EventLog) -> list[list[float]]:
    places = [event[3][:2] for event in log.events if event[1] == 'robot'] or [[0, 0], [1, 1]]
    low, high = np.min(places, axis=0) - 1.0, np.max(places, axis=0) + 1.0
    return np.stack([low, high], axis=1).tolist()


def _draw_floor(axes: Any, moments: Moments, time: float) -> None:
    for event in moments.now('map', time):
        (x, y, _), (dx, dy, _), (nx, ny, _), digits = event[3:7]
        values = np.frombuffer(digits.encode(), np.uint8).reshape(nx, ny).T - ord('0')
        extent = (x - dx / 2, x + (nx - 0.5) * dx, y - dy / 2, y + (ny - 0.5) * dy)
        axes.imshow(values, origin='lower', extent=extent, cmap='Greys', vmin=0, vmax=24)
        break
    scene = moments.log.scene
    kept = max((robot.get('clearance', 0.0) for robot in scene['robots'].values()), default=0.0)
    for *centre, radius in scene.get('obstacles', []):
        axes.add_patch(Circle(centre[:2], radius, color='#59636e'))
        if kept:
            axes.add_patch(Circle(centre[:2], radius + kept, fill=False, ls='--', ec='#59636e'))


def _draw_boxes(axes: Any, moments: Moments, time: float) -> None:
    scene = moments.log.scene
    visited = moments.visited(time)
    for box in scene.get('objects', []):
        draw_box(axes, np.array(box), '#B9B9C9', 0.35, '')
    for box in scene.get('blocks', []):
        draw_box(axes, np.array(box), '#8A8478', 0.6, '')
    for number, box in enumerate(scene.get('cuboids', [])):
        done = number in visited
        colour = _VISITED if done else _OPEN
        draw_box(axes, np.array(box), colour, 0.12 if done else 0.35, '')


def _draw_targets(axes: Any, moments: Moments, time: float, spatial: bool) -> None:
    size = 3 if spatial else 2
    for event in moments.now('truth', time):
        axes.plot(*np.array(event[3]).reshape(-1, 3)[:, :size].T, 'x', color='0.2', ms=6)
    for event in moments.now('filter', time):
        for x, y, z, mass, *covariance in event[4]:
            _mark(axes, (x, y, z)[:size], covariance, 2.0, _POTENTIAL, min(0.3 + mass, 1.0))
    for event in moments.now('found', time):
        for number, x, y, z, covariance, *_ in event[3]:
            _mark(axes, (x, y, z)[:size], covariance, 3.0, _FOUND, 1.0)
            axes.text(*(x, y, z)[:size], f'  {number}', fontsize=8)
    for name in moments.log.scene.get('robots', {}):
        for when, *_, place, detections in reversed(moments.until('seen', name, time)):
            if when < time - _FADE:
                break
            for reach, bearing, elevation, *_ in detections:
                level = reach * math.cos(elevation)
                spot = np.add(
                    place,
                    (
                        level * math.cos(bearing),
                        level * math.sin(bearing),
                        reach * math.sin(elevation),
                    ),
                )
                axes.plot(*spot[:size, None], '+', color=_SEEN, ms=6)


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
    if len(place) == 3:
        return
    xx, xy, _, yy, *_ = covariance
    values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    widths = 2.0 * deviations * np.sqrt(np.maximum(values, 0.0))
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    axes.add_patch(
        Ellipse(
            (place[0], place[1]),
            widths[1],
            widths[0],
            angle=angle,
            fill=False,
            color=colour,
            alpha=alpha,
        )
    )


def _draw_robots(axes: Any, moments: Moments, time: float, spatial: bool) -> None:
    size = 3 if spatial else 2
    now = {event[2]: event for event in moments.now('robot', time)}
    for index, name in enumerate(moments.robots):
        if name not in now:
            continue
        colour = _NAMED.get(name, _ROBOTS[index % len(_ROBOTS)])
        path = np.array([event[3][:size] for event in moments.until('robot', name, time)])
        axes.plot(*path.T, '-', color=colour, lw=1.3)
        status = now[name][5]
        ways = moments.until('way', name, time) if status == MOVING else []
        if ways and ways[-1][3]:
            axes.plot(*np.array(ways[-1][3])[:, :size].T, '--', color=colour, lw=1.3)
        waypoint = moments.waypoint(name, time)
        if waypoint is not None and status == MOVING:
            axes.plot(*np.array(waypoint)[:size, None], 's', color=colour, ms=8, mfc='none')
        *place, yaw = now[name][3]
        away = status in (UNAVAILABLE, LEFT, SILENT)
        if not away:
            _draw_view(axes, moments.log.scene, name, now[name][3], colour)
        marker: Any = 'D' if spatial else _arrow(yaw)
        axes.plot(
            *np.array(place)[:size, None],
            marker=marker,
            color=colour,
            ms=8 if spatial else 16,
            alpha=0.35 if away else 1.0,
        )
        axes.text(*place[:size], f'   {name}', fontsize=9, weight='bold')
        fence = moments.log.scene.get('robots', {}).get(name, {}).get('fence')
        if fence:
            _draw_fence(axes, fence, colour, spatial)


def _arrow(yaw: float) -> Outline:
    """Return a marker that points along a yaw [rad]."""
    ahead, left = np.array([1.4, -0.9, -0.5, -0.9, 1.4]), np.array([0.0, 0.8, 0.0, -0.8, 0.0])
    cos, sin = math.cos(yaw), math.sin(yaw)
    return Outline(np.column_stack([ahead * cos - left * sin, ahead * sin + left * cos]))


def _draw_view(axes: Any, scene: dict[str, Any], name: str, pose: list[float], colour: str) -> None:
    """Draw the field of view; in space only how high the robot is."""
    x, y, z, yaw = pose
    if len(scene.get('bounds') or [0, 0]) == 3:
        axes.plot([x, x], [y, y], [scene['bounds'][2][0], z], ':', color=colour, lw=0.8)
        return
    view = scene['robots'].get(name, {}).get('view')
    if view is None:
        return
    style: Any = {'ec': colour, 'fc': (*to_rgb(colour), 0.12), 'ls': ':'}
    if view['kind'] == 'box':
        (left, low), (right, high) = view['lower'][:2], view['upper'][:2]
        corners = np.array([[left, low], [right, low], [right, high], [left, high]])
        turn = yaw if view['turns'] else 0.0
        turned = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        axes.add_patch(Polygon(corners @ turned + (x, y), **style))
    else:
        wide, high = view['size'][:2]
        axes.add_patch(Ellipse((x, y), 2.0 * wide, 2.0 * high, **style))


def _draw_links(axes: Any, moments: Moments, time: float) -> None:
    """Draw lines between robots of which one hears the other."""
    places = {event[2]: event[3][:3] for event in moments.now('robot', time)}
    for event in moments.now('cuboid', time):
        for other in event[6]:
            if event[2] in places and other in places:
                ends = np.array([places[event[2]], places[other]])
                axes.plot(*ends.T, ':', color='0.3', lw=1.0)


def _draw_fence(axes: Any, fence: list[list[float]], colour: str, spatial: bool) -> None:
    """Draw the edges of a geofence (3, 2) [m]."""
    (left, right), (low, high), heights = fence
    corners = [(left, low), (right, low), (right, high), (left, high)]
    ring = np.array([*corners, corners[0]])
    style = {'color': colour, 'lw': 0.9, 'alpha': 0.7, 'linestyle': '-.'}
    if not spatial:
        axes.plot(*ring.T, **style)
        return
    for z in heights:
        axes.plot(*ring.T, np.full(len(ring), z), **style)
    for x, y in corners:
        axes.plot([x, x], [y, y], heights, **style)

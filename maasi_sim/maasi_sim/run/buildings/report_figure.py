"""The report figure of a search of buildings."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from maasi_filter.arrays import FloatArray
from maasi_filter.colours import OPEN, VISITED, robot_colours
from maasi_filter.wording import counted, number
from maasi_sim.run.buildings.observer import CuboidRecord, build_cuboid_report
from maasi_sim.run.buildings.picture import OBJECT, OBSTACLE
from maasi_sim.run.report_files import reason_of_end
from maasi_sim.run.report_panels import MARGIN, MapView, draw_report


def plot_cuboid_report(record: CuboidRecord) -> Figure:
    """Return a figure of the mission from above and the sides, and of visited cuboids over time."""
    visited = {shot['cuboid'] for shot in record.snapshots}
    return draw_report(
        record,
        robot_colours(record.scenario.names()),
        _area(record),
        lambda view: _draw_mission(view, record, visited),
        [
            ('', 1.0, lambda axes: _draw_visited(axes, record)),
            ('time [s]', 0.7, lambda axes: _draw_active(axes, record)),
        ],
        'Cuboids visited',
        _rows(record),
    )


def _area(record: CuboidRecord) -> FloatArray:
    mission = record.mission
    boxes = [*mission.objects, *mission.obstacles, *mission.boxes]
    corners = [np.asarray(box, dtype=float).T for box in boxes]
    points = np.concatenate([*corners, *(path[:, 1:] for path in record.trajectories.values())])
    area = np.stack([points.min(axis=0), points.max(axis=0)], axis=1)
    area[2, 0] = min(area[2, 0], mission.area[2, 0])
    return area


def _draw_mission(view: MapView, record: CuboidRecord, visited: set[int]) -> None:
    mission = record.mission
    done = [box for number, box in enumerate(mission.boxes) if number in visited]
    missed = [box for number, box in enumerate(mission.boxes) if number not in visited]
    kinds = (
        (mission.objects, OBJECT, 0.5, 'object', 0.6),
        (mission.obstacles, OBSTACLE, 0.6, 'obstacle', 0.6),
        (done, VISITED, 0.25, 'cuboid, visited', 0.6),
        (missed, OPEN, 0.55, 'cuboid, missed', 2.0),
    )
    for boxes, colour, alpha, label, width in kinds:
        for box in np.asarray(boxes, dtype=float).reshape(-1, 3, 2):
            low, high = box[list(view.plane)].T
            view.axes.add_patch(
                Rectangle(
                    (low[0], low[1]),
                    *(high - low),
                    fc=to_rgba(colour, alpha),
                    ec=colour,
                    lw=width,
                    label=label,
                )
            )


def _draw_visited(axes: Axes, record: CuboidRecord) -> None:
    seen: set[int] = set()
    times, counts = [0.0], [0]
    for shot in record.snapshots:
        seen.add(shot['cuboid'])
        times.append(shot['time'])
        counts.append(len(seen))
    axes.step(
        [*times, record.end_time], [*counts, counts[-1]], where='post', color='#D62728', lw=2.0
    )
    axes.axhline(len(record.mission.cells), color='#222222', lw=1.0, ls='--')
    axes.set_ylabel('cuboids')


def _draw_active(axes: Axes, record: CuboidRecord) -> None:
    axes.step(record.active[:, 0], record.active[:, 1], where='post', color='#009E73', lw=2.0)
    axes.set_xlim(0.0, MARGIN * max(record.end_time, 1e-9))
    axes.set_ylim(0.0, len(record.scenario.robots) + 0.5)
    axes.set_ylabel('searching robots')


def _rows(record: CuboidRecord) -> list[tuple[str, str]]:
    report = build_cuboid_report(record)
    least, complete = report['least_detection_probability'], report['time_to_find_all']
    return [
        ('visited', f'{report["cuboids"]["visited"]} of {report["cuboids"]["total"]}'),
        ('all visited after', '-' if complete is None else f'{complete:.0f} s'),
        ('smallest p_d', '-' if least is None else f'{number(least)} of a snapshot'),
        ('collisions', str(report['collisions'])),
        *((key, counted(count, 'decision')) for key, count in report['choices'].items()),
        ('ended', f'{reason_of_end(report)}, at {record.end_time:.1f} s'),
    ]

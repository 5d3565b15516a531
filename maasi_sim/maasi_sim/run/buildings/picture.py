"""3D pictures of a search of buildings (paper 004)."""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.colours import OPEN, VISITED, robot_colours
from maasi_planner.buildings.preplanning import CoveragePlan

OBJECT, OBSTACLE = '#B9B9C9', '#8A8478'
_SIDES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))


def draw_mission(
    axes: Any,
    mission: CoveragePlan,
    paths: Mapping[str, ArrayLike],
    visited: Collection[int],
    plans: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Draw a mission on 3D axes: paths (n, 3) [m], visited cuboids, predicted positions."""
    for box in mission.objects:
        draw_box(axes, box, OBJECT, 0.35, 'object')
    for box in mission.obstacles:
        draw_box(axes, box, OBSTACLE, 0.6, 'obstacle')
    seen = set(visited)
    for number, box in enumerate(mission.boxes):
        done = number in seen
        draw_box(
            axes,
            box,
            VISITED if done else OPEN,
            0.12 if done else 0.35,
            'cuboid, visited' if done else 'cuboid, not visited',
        )
    for name, colour in robot_colours(paths).items():
        path = np.asarray(paths[name], dtype=float).reshape(-1, 3)
        axes.plot(*path.T, '-', color=colour, lw=1.4, label=name)
        axes.plot(*path.T, 'D', color=colour, ms=2.2)
        if len(path):
            axes.plot(*path[:1].T, 's', color=colour, ms=8, mec='white')
            axes.plot(*path[-1:].T, 'o', color=colour, ms=7, mec='white')
        if plans and name in plans:
            plan = np.asarray(plans[name], dtype=float)
            axes.plot(*plan.T, 'o--', color=colour, ms=3, lw=0.8, mfc='none')
    axes.set_xlim(*mission.area[0])
    axes.set_ylim(*mission.area[1])
    axes.set_zlim(*mission.area[2])
    axes.set_box_aspect(mission.area[:, 1] - mission.area[:, 0], zoom=1.05)
    axes.set_xlabel('x [m]')
    axes.set_ylabel('y [m]')
    axes.set_zlabel('z [m]')
    axes.view_init(elev=34, azim=-62)


def legend(axes: Any, columns: int = 4) -> None:
    """Add a legend with each label once."""
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles))
    axes.legend(
        unique.values(),
        unique.keys(),
        loc='upper center',
        bbox_to_anchor=(0.5, -0.02),
        ncols=columns,
        fontsize=8,
        frameon=False,
    )


def draw_box(axes: Any, box: FloatArray, colour: str, alpha: float, label: str) -> Any:
    """Draw a box (3, 2) [m] on 3D axes, and return its sides."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    corners = np.array([[x, y, z] for x in box[0] for y in box[1] for z in box[2]])
    sides = [corners[list(side)] for side in _SIDES]
    solid = Poly3DCollection(sides, facecolor=colour, edgecolor=colour, alpha=alpha, linewidth=0.4)
    axes.add_collection3d(solid)
    # Collections have no legend handle in 3D.
    axes.plot([], [], [], 's', color=colour, alpha=max(alpha, 0.35), label=label)
    return solid

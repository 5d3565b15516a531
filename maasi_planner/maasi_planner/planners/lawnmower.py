"""Lawnmower: lanes that cover the area evenly (000, sections 5 and 7).

Two robots start from both ends and meet between them; more robots divide the lanes into blocks,
two to a block.
"""

import itertools
import math
from typing import Literal

import numpy as np
from pydantic import Field

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_planner.candidates import half_view
from maasi_planner.planners.base import Planner, explain
from maasi_planner.planners.detour import PASSES, others_move, past_standing
from maasi_planner.planners.options import held_back
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import (
    CROSSED,
    SAVES_BATTERY,
    Decision,
    RobotDecision,
    RobotView,
    TeamView,
    single_choice,
    stay,
)


class LawnmowerSettings(PlannerSettings):
    """Settings of `lawnmower`; its robots share the lanes."""

    coordination: Literal['centralized'] = Field(
        'centralized', description='All robots share one filter and choose jointly'
    )
    lane_spacing: float | None = Field(
        None, gt=0.0, description='Distance between lanes; default: width of the field of view [m]'
    )
    layer_spacing: float | None = Field(
        None, gt=0.0, description='Distance between layers in 3D; default: that of lanes [m]'
    )
    margin: float | None = Field(
        None,
        ge=0.0,
        description='Distance of the outer lanes from the bounds; default: half a lane [m]',
    )


def lanes(
    bounds: FloatArray, spacing: float, layer_spacing: float, margin: float
) -> list[FloatArray]:
    """Return the lanes that cover an area."""
    d = len(bounds)
    low = bounds[:, 0] + margin
    high = bounds[:, 1] - margin
    middle = bounds.mean(axis=1)
    low = np.minimum(low, middle)
    high = np.maximum(high, middle)

    def levels(axis: int, distance: float) -> list[float]:
        length = float(high[axis] - low[axis])
        number = math.ceil(length / distance - 1e-9) + 1 if length > 1e-12 else 1
        if number == 1:
            return [float(middle[axis])]
        return [float(low[axis]) + length * i / (number - 1) for i in range(number)]

    out = []
    backwards_x = backwards_y = False
    for z in levels(2, layer_spacing) if d == 3 else [0.0]:
        rows = levels(1, spacing)
        for y in reversed(rows) if backwards_y else rows:
            ends = [(float(low[0]), y, z), (float(high[0]), y, z)]
            out.append(np.array(ends[::-1] if backwards_x else ends))
            backwards_x = not backwards_x
        backwards_y = not backwards_y
    return out


class Lawnmower(Planner):
    """Lanes in order, without the candidates; faster robots cover more lanes."""

    keys = LawnmowerSettings
    settings: LawnmowerSettings

    def __init__(self, settings: LawnmowerSettings) -> None:
        super().__init__(settings)
        # Lanes by block: all, and those that no robot has begun.
        self._all: list[list[FloatArray]] = []
        self._blocks: list[list[FloatArray]] = []
        self._area: Area | None = None
        self._side: dict[str, tuple[int, int]] = {}
        self._pending: dict[str, list[FloatArray]] = {}
        # Lanes that some robots cannot afford with a full battery, and these robots.
        self._too_far: list[tuple[FloatArray, set[str]]] = []
        # Lane of each robot, and the robots that could not afford it.
        self._lane: dict[str, FloatArray] = {}
        self._refused: dict[str, set[str]] = {}
        self._started = False

    def _spacing(self, team: TeamView) -> float:
        if self.settings.lane_spacing is not None:
            return self.settings.lane_spacing
        widths = [2.0 * half_view(view.sensor) for view in team.robots.values()]
        finite = [width for width in widths if math.isfinite(width)]
        size = float((team.bounds[:, 1] - team.bounds[:, 0]).max())
        return max(min([*finite, size]), size / 1000.0)

    def _start(self, team: TeamView) -> None:
        spacing = self._spacing(team)
        margin = self.settings.margin
        all_lanes = lanes(
            team.bounds,
            spacing,
            self.settings.layer_spacing or spacing,
            0.5 * spacing if margin is None else margin,
        )
        names = team.names()
        blocks = min(max(1, math.ceil(len(names) / 2)), len(all_lanes))
        self._blocks = [
            all_lanes[len(all_lanes) * i // blocks : len(all_lanes) * (i + 1) // blocks]
            for i in range(blocks)
        ]
        self._all, self._area = [list(members) for members in self._blocks], team.area
        ends = [
            (block, side, members[-side][side])
            for block, members in enumerate(self._blocks)
            for side in (0, 1)
        ]
        free = list(ends)
        # In the order of names, each robot starts from the nearest free end.
        for name in names:
            position = team.robots[name].state.pose.position
            free = free or list(ends)
            gaps = [((end[2] - position)[: team.dimension] ** 2).sum() for end in free]
            block, side, _ = free.pop(int(np.argmin(gaps)))
            self._side[name] = (block, side)
            self._pending[name] = []
        self._started = True

    def _open_again(self, team: TeamView) -> None:
        """Put back lanes with unexplored ground after a change of the area."""
        if not self._started or self._area is team.area:
            return
        self._area = team.area
        under_way = [self._lane[name] for name, ends in self._pending.items() if ends]
        known = [id(lane) for lane in itertools.chain(*self._blocks, under_way)]
        known += [id(lane) for lane, _ in self._too_far]
        for block, members in zip(self._blocks, self._all):
            block += [lane for lane in members if id(lane) not in known and _unseen(team, lane)]

    def _next(self, team: TeamView, name: str) -> FloatArray | None:
        if name not in self._side:
            self._side[name] = (len(self._side) % len(self._blocks), len(self._side) % 2)
            self._pending[name] = []
        if self._pending[name]:
            return self._pending[name].pop(0)
        own, side = self._side[name]
        order = [own] + [i for i in range(len(self._blocks)) if i != own]
        for block in order:
            members = self._blocks[block]
            if not members:
                continue
            return self._begin(team, name, members.pop(0 if side == 0 else -1))
        for row, (lane, names) in enumerate(self._too_far):
            if name not in names:
                del self._too_far[row]
                return self._begin(team, name, lane, names)
        return None

    def _begin(
        self, team: TeamView, name: str, lane: FloatArray, refused: set[str] | None = None
    ) -> FloatArray:
        """Assign a lane that some robots `refused` to a robot; return its nearer end."""
        view = team.robots[name]
        here = view.state.pose.position
        ends = [lane[0].copy(), lane[1].copy()]
        if team.dimension == 2:
            for end in ends:
                end[2] = view.height
        gaps = [float(((end - here) ** 2).sum()) for end in ends]
        if gaps[1] < gaps[0]:
            ends.reverse()
        self._pending[name] = [ends[1]]
        self._lane[name], self._refused[name] = lane, refused or set()
        return ends[0]

    def _give_up(self, name: str) -> None:
        """Return the lane of a robot, which cannot afford it with a full battery."""
        self._pending[name] = []
        self._too_far.append((self._lane[name], self._refused[name] | {name}))

    def decide(self, team: TeamView) -> Decision:
        """See `Planner.decide`."""
        decision = Decision(step=team.step)
        if not self._started:
            self._start(team)
        self._open_again(team)
        for name in team.planning():
            decision.robots[name] = self._decide_one(team, name, decision)
        return explain(decision)

    def _decide_one(self, team: TeamView, name: str, decision: Decision) -> RobotDecision:
        view = team.robots[name]
        here, out_of_reach = view.state.pose.position, 'stays: all lanes are complete'
        while True:
            target = self._next(team, name)
            if target is None:
                return stay(view, out_of_reach)
            point = view.motion.keep_out.moved_out(here, target)
            if point is None:
                continue
            prediction = view.motion.predict(view.state, point[None, :], team.step_time)
            if not prediction.reached[0] or prediction.lengths[0] == 0:
                continue
            if held := held_back(team, name, prediction, decision):
                if SAVES_BATTERY in held and _is_full(view):
                    self._give_up(name)
                    out_of_reach = held
                    continue
                if held == CROSSED and not others_move(team, name, decision):
                    if detour := past_standing(team, name, point, decision):
                        self._pending[name].insert(0, target)
                        return single_choice(*detour, 0, PASSES)
                    continue
                self._pending[name].insert(0, target)
                return stay(view, held)
            return single_choice(point[None, :], prediction, 0, 'goes to the next end of a lane')

    def finished(self, team: TeamView) -> str | None:
        """See `Planner.finished`; also if every lane is complete that some robot can afford."""
        self._open_again(team)
        if self._started and not any(self._blocks) and not any(self._pending.values()):
            searching = set(self.searching(team))
            left = [names for _, names in self._too_far if not searching <= names]
            if not left and not any(view.underway for view in team.robots.values()):
                return self._reason(team)
        return super().finished(team)

    def _reason(self, team: TeamView) -> str:
        if not self._too_far:
            return 'all lanes of the lawnmower are complete'
        return (
            f'all lanes of the lawnmower are complete but {len(self._too_far)}, for which a full '
            f'battery does not suffice ({team.exploration.describe()})'
        )


def _is_full(view: RobotView) -> bool:
    """Return whether a robot is at its charger with the highest charge that it gives."""
    endurance = view.endurance
    return (
        endurance is not None and endurance.topped and endurance.is_home(view.state.pose.position)
    )


def _unseen(team: TeamView, lane: FloatArray) -> bool:
    """Return whether a part of a lane is open and mostly unexplored."""
    number = 2 + int(np.linalg.norm(lane[1] - lane[0]) / team.exploration.step.min())
    levels = lane[0] + np.linspace(0.0, 1.0, number)[:, None] * (lane[1] - lane[0])
    levels = levels[team.area.inside(levels)]
    return len(levels) > 0 and bool((team.exploration.at(levels) > 0.5).any())

"""Stores recordings of golden runs, and compares a run with its recording."""

from __future__ import annotations

import json
import lzma
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from golden_runs import Recording

from maasi_sim.machine import machine_difference, this_machine

FOLDER = Path(__file__).resolve().parent / 'stored'
# Of lengths, as a share of the longest side of the environment; of other numbers, relative to
# them where they are above 1. Whole numbers and names are compared exactly.
TOLERANCE = 1e-6
# On another processor or with other versions than those of the stored runs: a sum that is rounded
# otherwise draws another particle here and there. See docs/repeatability.md.
TOLERANCE_ELSEWHERE = 2e-2
# Rounded to less than a tenth of the tolerance.
_ROUNDED = 0.1 * TOLERANCE
# Columns of lengths [m].
LENGTHS = ('waypoint', 'mean', 'position')
# Only in recordings to the bit.
_BITS = 'bits'


@dataclass(frozen=True)
class Difference:
    """A quantity of a run that is not as it was, and the step at which it differs first.

    Without a step it differs at the end.
    """

    run: str
    step: int | None
    quantity: str
    text: str

    def __str__(self) -> str:
        where = 'at the end' if self.step is None else f'step {self.step}'
        return f'{self.run}: {where}: {self.quantity}: {self.text}'


def path_of(name: str) -> Path:
    """Return where the recordings of a scenario or an experiment are stored."""
    return FOLDER / f'{name}.json.xz'


def rounded(recording: Recording) -> Recording:
    """Return a recording as it is stored: rounded, and without hashes."""
    scale = recording['size']
    result: Recording = {'size': scale}
    for kind, table in recording.items():
        if kind != 'size':
            result[kind] = {
                column: _round(values, scale if column in LENGTHS else 1.0)
                for column, values in table.items()
                if column != _BITS
            }
    return result


def _round(value: Any, scale: float) -> Any:
    if isinstance(value, list):
        return [_round(item, scale) for item in value]
    if isinstance(value, float) and math.isfinite(value):
        return round(value, math.ceil(-math.log10(_ROUNDED * scale)))
    return value


def write(path: Path, recordings: dict[str, Any]) -> None:
    """Store recordings by their names, and on what machine they were made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {'machine': this_machine(), 'recordings': recordings}
    text = json.dumps(content, separators=(',', ':'))
    path.write_bytes(lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME))


def read(path: Path) -> tuple[dict[str, Any], str]:
    """Return what was stored, and in what this machine differs from the one that it was made on."""
    content = json.loads(lzma.decompress(path.read_bytes()))
    return content['recordings'], machine_difference(content['machine'], this_machine())


def tolerance_for(difference: str) -> float:
    """Return the tolerance for a difference of machines."""
    return TOLERANCE_ELSEWHERE if difference else TOLERANCE


def differences(run: str, stored: Recording, now: Recording, tolerance: float) -> list[Difference]:
    """Return what differs between two recordings of a run: of each quantity the first place.

    `run` is its name; see `tolerance_for`, 0 compares to the bit.
    """
    found, sizes = [], (stored['size'], now['size'])
    if sizes[0] != sizes[1]:
        text = f'{sizes[0]:g} m before, {sizes[1]:g} m now'
        found.append(Difference(run, None, 'size', text))
    for kind in dict.fromkeys(kind for kind in [*stored, *now] if kind != 'size'):
        before, after = stored.get(kind, {}), now.get(kind, {})
        steps: tuple[list[Any], ...] = before.get('step', []), after.get('step', [])
        if kind == 'end':
            # A table of one row.
            names = dict.fromkeys([*before, *after])
            before, after = ({name: [end.get(name)] for name in names} for end in (before, after))
            steps = [None], [None]
        for quantity in before or after:
            rows = before.get(quantity, []), after.get(quantity, [])
            # Stored recordings have no hashes.
            if quantity == _BITS and not all(_BITS in table for table in (before, after) if table):
                continue
            scale = sizes[0] if quantity in LENGTHS else None
            every = [_difference(old, new, scale, tolerance) for old, new in zip(*rows)]
            wrong = [(step, item[1]) for step, item in zip(steps[0], every) if item is not None]
            if wrong and kind == 'end':
                found.append(Difference(run, None, quantity, wrong[0][1]))
            elif wrong:
                text = f'{wrong[0][1]}; so in {len(wrong)} of {len(every)}'
                found.append(Difference(run, wrong[0][0], f'{kind}.{quantity}', text))
        numbers = len(steps[0]), len(steps[1])
        if numbers[0] != numbers[1]:
            step = max(steps, key=len)[min(numbers)]
            text = f'{numbers[0]} before, {numbers[1]} now'
            found.append(Difference(run, step, f'number of {kind}', text))
    return sorted(found, key=lambda item: math.inf if item.step is None else item.step)


def _difference(
    before: Any, after: Any, scale: float | None, tolerance: float
) -> tuple[float, str] | None:
    """Return by how much two values, or lists of them, differ, also in words; None: they do not.

    `scale` is that of lengths [m], None of other numbers.
    """
    if isinstance(before, list) and isinstance(after, list):
        if len(before) != len(after):
            return math.inf, f'{len(before)} before, {len(after)} now'
        every = [_difference(old, new, scale, tolerance) for old, new in zip(before, after)]
        return max((item for item in every if item is not None), default=None)
    if isinstance(before, float) and isinstance(after, float):
        moved = abs(after - before)
        allowed = tolerance * (max(1.0, abs(before)) if scale is None else scale)
        if before == after or moved <= allowed or (math.isnan(before) and math.isnan(after)):
            return None
        share = '' if scale is None else f' m, {moved / scale:.2g} of the size'
        return moved, f'moved by {moved:.3g}{share} ({before:.9g} before, {after:.9g} now)'
    return None if before == after else (math.inf, f'{before} before, {after} now')

"""Run the golden runs and print what moved; store them again with --write."""

import argparse
import json
import lzma
import math
import sys
import time
from pathlib import Path
from typing import Any

from golden_runs import Recording, runs

from maasi_filter.wording import counted
from maasi_sim.machine import machine_difference, this_machine

FOLDER = Path(__file__).resolve().parent / 'stored'
# Of lengths, as a share of the longest side of the environment; of other numbers, relative to
# them where they are above 1. Whole numbers and names are compared exactly.
TOLERANCE = 1e-6
# On another processor or with other versions than those of the stored runs: a sum that is rounded
# otherwise draws another particle here and there. See docs/repeatability.md.
TOLERANCE_ELSEWHERE = 2e-2
LENGTHS = ('waypoint', 'mean', 'position')  # columns of lengths [m]
BITS = 'bits'  # only in recordings to the bit


def path_of(name: str) -> Path:
    """Return where the recordings of a scenario or an experiment are stored."""
    return FOLDER / f'{name}.json.xz'


def rounded(recording: Recording) -> Recording:
    """Return a recording as it is stored: without hashes, rounded to a tenth of the tolerance."""
    scale = recording['size']
    result: Recording = {'size': scale}
    for kind, table in recording.items():
        if kind != 'size':
            result[kind] = {
                column: _round(values, scale if column in LENGTHS else 1.0)
                for column, values in table.items()
                if column != BITS
            }
    return result


def _round(value: Any, scale: float) -> Any:
    if isinstance(value, list):
        return [_round(item, scale) for item in value]
    if isinstance(value, float) and math.isfinite(value):
        return round(value, math.ceil(-math.log10(0.1 * TOLERANCE * scale)))
    return value


def write(path: Path, recordings: dict[str, Any]) -> None:
    """Store recordings by their names, and on what machine they were made."""
    content = {'machine': this_machine(), 'recordings': recordings}
    text = json.dumps(content, separators=(',', ':'))
    path.write_bytes(lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME))


def read(path: Path) -> tuple[dict[str, Any], str]:
    """Return what was stored, and in what this machine differs from the one that it was made on."""
    content = json.loads(lzma.decompress(path.read_bytes()))
    return content['recordings'], machine_difference(content['machine'], this_machine())


def _rows(recording: Recording, kind: str) -> list[tuple[int | None, dict[str, Any]]]:
    """Return the events of a kind with their steps; of size and end there is one."""
    table = recording.get(kind, {})
    if kind in ('size', 'end'):
        return [(None, table if kind == 'end' else {'size': table})]
    rows = zip(*table.values())
    return [(step, dict(zip(table, row))) for step, row in zip(table.get('step', []), rows)]


def differences(stored: Recording, now: Recording, tolerance: float) -> list[str]:
    """Return what differs between two recordings of a run: of each quantity the first place."""
    found: dict[str, tuple[float, str]] = {}
    for kind in dict.fromkeys([*stored, *now]):
        first, second = _rows(stored, kind), _rows(now, kind)
        for (step, before), (_, after) in zip(first, second):
            where = 'at the end: ' if step is None else f'step {step}: {kind}.'
            for name in dict.fromkeys([*before, *after]):
                # Stored recordings have no hashes.
                if name == BITS and not (BITS in before and BITS in after):
                    continue
                scale = stored['size'] if name in LENGTHS else None
                text = _moved(before.get(name), after.get(name), scale, tolerance)
                if text and f'{kind}.{name}' not in found:
                    order = math.inf if step is None else step
                    found[f'{kind}.{name}'] = order, f'{where}{name}: {text}'
        if len(first) != len(second):
            step = max(first, second, key=len)[min(len(first), len(second))][0]
            text = f'step {step}: number of {kind}: {len(first)} before, {len(second)} now'
            found[kind] = step, text
    return [text for _, text in sorted(found.values(), key=lambda item: item[0])]


def _moved(before: Any, after: Any, scale: float | None, tolerance: float) -> str:
    """Return in words by how much two values, or lists of them, differ; '' if they do not."""
    if isinstance(before, list) and isinstance(after, list):
        if len(before) != len(after):
            return f'{len(before)} before, {len(after)} now'
        every = (_moved(old, new, scale, tolerance) for old, new in zip(before, after))
        return next(filter(None, every), '')
    if isinstance(before, float) and isinstance(after, float):
        moved = abs(after - before)
        allowed = tolerance * (max(1.0, abs(before)) if scale is None else scale)
        if before == after or moved <= allowed or (math.isnan(before) and math.isnan(after)):
            return ''
        share = '' if scale is None else f' m, {moved / scale:.2g} of the size'
        return f'moved by {moved:.3g}{share} ({before:.9g} before, {after:.9g} now)'
    return '' if before == after else f'{before} before, {after} now'


def moved(
    name: str, made: dict[str, Recording], stored: dict[str, Recording], tolerance: float
) -> list[str]:
    """Return what differs in the runs of a scenario or an experiment."""
    found = []
    for key in dict.fromkeys([*stored, *made]):
        if key in stored and key in made:
            found += [
                f'{name}, {key}: {text}' for text in differences(stored[key], made[key], tolerance)
            ]
        else:
            only = 'one before, none now' if key in stored else 'none before, one now'
            found.append(f'{name}, {key}: run: {only}')
    return found


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(
        prog='golden',
        description='Run the golden runs and print each difference: run, step, quantity, amount.',
        epilog='Exit codes: 0 no difference, or --write; 1 differences; 2 wrong input.',
    )
    parser.add_argument(
        'names', nargs='*', metavar='NAME', help='scenarios or experiments (default: all)'
    )
    parser.add_argument(
        '--write', action='store_true', help='store the results as the new golden runs'
    )
    parser.add_argument(
        '--save', type=Path, metavar='FILE', help='write the runs with all bits, for --against'
    )
    parser.add_argument(
        '--against',
        type=Path,
        metavar='FILE',
        help='compare bit by bit with a file of --save from the same machine',
    )
    options = parser.parse_args(arguments)
    known = runs()
    for name in options.names:
        if name not in known:
            parser.error(f"unknown '{name}'; allowed are {', '.join(known)}")
    begin = time.monotonic()
    wanted = options.names or known
    made = {name: {key: run() for key, run in known[name].items()} for name in wanted}
    every, elsewhere = read(options.against) if options.against else ({}, '')
    found = []
    for name, recordings in made.items():
        stored = every.get(name, {})
        if not options.against and path_of(name).exists():
            stored, elsewhere = read(path_of(name))
        tolerance = TOLERANCE_ELSEWHERE if elsewhere else TOLERANCE
        found += moved(name, recordings, stored, 0.0 if options.against else tolerance)
    if elsewhere:
        print(f'the golden runs are from another machine: {elsewhere}')
    print(*found, sep='\n', end='\n' if found else '')
    number = sum(len(item) for item in made.values())
    how = ', to the bit' if options.against else ''
    spent = time.monotonic() - begin
    print(f'{counted(number, "run")} in {spent:.0f} s{how}: {counted(len(found), "difference")}')
    if options.save:
        write(options.save, made)
    if options.write:
        for name, recordings in made.items():
            write(path_of(name), {key: rounded(item) for key, item in recordings.items()})
    return 1 if found and not options.write else 0


if __name__ == '__main__':
    sys.exit(main())

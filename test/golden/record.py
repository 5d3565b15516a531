"""Run the golden runs and print what moved; store them anew with --write."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from golden_files import (
    Difference,
    differences,
    path_of,
    read,
    rounded,
    tolerance_for,
    write,
)
from golden_runs import Recording, runs

EQUAL, MOVED, WRONG_INPUT = 0, 1, 2


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(
        prog='golden',
        description='Run the golden runs and print what moved: run, step, quantity, by how much.',
        epilog='Exit codes: 0 nothing moved, or stored anew; 1 something moved; 2 wrong input.',
    )
    parser.add_argument('names', nargs='*', metavar='NAME', help='scenarios or experiments')
    parser.add_argument('--write', action='store_true', help='store what came out')
    parser.add_argument(
        '--save', type=Path, metavar='FILE', help='keep the runs to the bit, for --against'
    )
    parser.add_argument(
        '--against',
        type=Path,
        metavar='FILE',
        help='compare with a file of --save, to the bit: on one machine, from commit to commit',
    )
    options = parser.parse_args(arguments)
    known = runs()
    unknown = [name for name in options.names if name not in known]
    if unknown:
        print(f"error: unknown '{unknown[0]}'; allowed are {', '.join(known)}", file=sys.stderr)
        return WRONG_INPUT
    begin = time.monotonic()
    made: dict[str, dict[str, Recording]] = {}
    for name in options.names or known:
        made[name] = {key: run() for key, run in known[name].items()}
    found = _compared(made, options.against)
    for item in found:
        print(item)
    number = sum(len(item) for item in made.values())
    how = ', to the bit' if options.against else ''
    spent = time.monotonic() - begin
    print(f'{number} runs in {spent:.0f} s{how}: {len(found)} quantities moved')
    if options.save:
        write(options.save, made)
    if options.write:
        for name, recordings in made.items():
            write(path_of(name), {key: rounded(item) for key, item in recordings.items()})
    return MOVED if found and not options.write else EQUAL


def _compared(made: dict[str, dict[str, Recording]], against: Path | None) -> list[Difference]:
    """Return what differs from the stored runs, or to the bit from those of a file."""
    every, elsewhere = read(against) if against else ({}, '')
    found = []
    for name, recordings in made.items():
        stored = every.get(name, {})
        if not against and path_of(name).exists():
            stored, elsewhere = read(path_of(name))
        tolerance = 0.0 if against else tolerance_for(elsewhere)
        for key in [*stored, *(key for key in recordings if key not in stored)]:
            run = f'{name}, {key}'
            if key not in stored:
                found.append(Difference(run, None, 'run', 'none before, one now'))
            elif key not in recordings:
                found.append(Difference(run, None, 'run', 'one before, none now'))
            else:
                found += differences(run, stored[key], recordings[key], tolerance)
    if elsewhere:
        print(f'stored on another machine: {elsewhere}')
    return found


if __name__ == '__main__':
    sys.exit(main())

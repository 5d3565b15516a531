"""Measure the speed of the suite, against baselines in the same run."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

AREAS = ('filter', 'planner', 'cuboid', 'drivers', 'system', 'view')


def load(area: str) -> ModuleType:
    """Return the module with the benchmarks of an area."""
    path = Path(__file__).parent / f'{area}_benchmark.py'
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def show(row: dict[str, Any]) -> str:
    """Return one result as a line."""
    text = f'{row["name"]:<36} {row["value"]:>12.4g} {row["unit"]:<6}'
    if row['baseline'] is not None:
        text += f' {row["ratio"]:>10.4g} x faster than {row["baseline"]}'
    return text


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmarks of some areas, or of all."""
    parser = argparse.ArgumentParser(prog='bench', description=__doc__)
    parser.add_argument('areas', nargs='*', metavar='AREA', help=f'{", ".join(AREAS)}; all if none')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the results there as well')
    parser.add_argument(
        '--quick',
        action='store_true',
        help='a tenth of the calls: shows that all works and roughly how fast',
    )
    options = parser.parse_args(arguments)
    if options.json is not None and not os.access(options.json.absolute().parent, os.W_OK):
        parser.error(f'--json: read {options.json}, allowed is a file in a folder that is there')
    if options.json is not None and options.json.is_dir():
        parser.error(f'--json: read {options.json}, a folder; allowed is a file')
    for area in options.areas:
        if area not in AREAS:
            parser.error(f'unknown area {area!r}, known are {", ".join(AREAS)}')
    rows: list[dict[str, Any]] = []
    for area in options.areas or AREAS:
        for row in load(area).run(0.1 if options.quick else 1.0):
            rows.append(row)
            print(show(row), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=2) + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())

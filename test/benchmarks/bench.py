"""Measure the speed of the suite, against baselines in the same run."""

import argparse
import json
import os
from importlib import import_module
from pathlib import Path

AREAS = ('filter', 'planner', 'scale', 'cuboid', 'drivers', 'terrain', 'system', 'view')


def show(row):
    text = f'{row["name"]:<36} {row["value"]:>12.4g} {row["unit"]:<6}'
    if row['ratio'] is not None:
        text += f' {row["ratio"]:>10.4g} x faster than {row["baseline"]}'
    elif row['baseline'] is not None:
        text += f' {"":>10} {row["baseline"]}'
    return text


def main():
    parser = argparse.ArgumentParser(prog='bench', description=__doc__)
    areas = f'what to measure: {", ".join(AREAS)} (default: all)'
    parser.add_argument('areas', nargs='*', choices=AREAS, metavar='AREA', help=areas)
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the results to FILE, too')
    quick = 'measure a tenth of the calls, with rough times'
    parser.add_argument('--quick', action='store_true', help=quick)
    options = parser.parse_args()
    file = options.json
    if file and (file.is_dir() or not os.access(file.absolute().parent, os.W_OK)):
        parser.error(f'--json: read {file}, allowed is a file in a folder that is there')
    rows = []
    for area in options.areas or AREAS:
        for row in import_module(f'{area}_benchmark').run(0.1 if options.quick else 1.0):
            rows.append(row)
            print(show(row), flush=True)
    if file:
        file.write_text(json.dumps(rows, indent=2) + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()

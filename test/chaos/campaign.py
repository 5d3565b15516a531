"""The command of the fault campaign: selects cases, runs them, summarises the results."""

import json
import os
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from fnmatch import fnmatchcase
from pathlib import Path

from chaos_cases import all_cases
from chaos_execution import execute
from chaos_verdict import judge

from maasi_sim.arguments import Parser, count, whole

PASSED, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130
GOLDEN = 0.6180339887498949


def build_parser():
    parser = Parser(
        prog='chaos',
        description='Run scenarios in which nodes are killed or hang and check the results: '
        'exit code, robots at rest, found targets, recording, report, processes.',
        epilog='Exit codes: 0 all cases passed, 1 some failed, 2 wrong input, 130 interrupted.',
    )
    add = parser.add_argument
    add('--list', action='store_true', help='list the cases and exit')
    add(
        '--case',
        nargs='+',
        action='extend',
        metavar='NAME',
        help='run only these cases; * is a wildcard',
    )
    add('--seed', type=whole, default=1, metavar='N', help='random seed of all runs (default: 1)')
    add('--json', type=Path, metavar='FILE', help='write the results to FILE')
    add(
        '--out', type=Path, metavar='DIR', help='keep the runs in DIR (default: a temporary folder)'
    )
    add('--jobs', type=count, default=1, metavar='N', help='run N cases in parallel (default: 1)')
    add(
        '--budget',
        type=float,
        metavar='S',
        help='start no case after S seconds; the order then alternates between kinds',
    )
    return parser


def chosen_cases(names):
    """Return the cases of some names or patterns; a pattern without any is a ValueError."""
    cases = all_cases()
    for name in names or ():
        if not any(fnmatchcase(case.name, name) for case in cases):
            raise ValueError(f'--case: read {name!r}, allowed are those of --list')
    chosen = names or ['*']
    return [case for case in cases if any(fnmatchcase(case.name, name) for name in chosen)]


def summary(results, seed, left_out):
    """Return the results as plain values."""
    counts = {}
    for item in results:
        *kind, nodes = item['name'].split('-')
        kind = ' '.join([*kind, 'two' if '+' in nodes else 'one'])
        counts.setdefault(kind, Counter())['failed' if item['problems'] else 'passed'] += 1
    failed = sum(bool(item['problems']) for item in results)
    return {
        'seed': seed,
        'passed': len(results) - failed,
        'failed': failed,
        'left_out': left_out,
        'counts': counts,
        'cases': results,
    }


def run_all(cases, folder, options):
    """Run cases, print each result, and write all results after each."""
    if options.budget is not None:
        # Spread evenly over the list, wherever the budget ends it.
        order = sorted(range(len(cases)), key=lambda index: (index * GOLDEN) % 1.0)
        cases = [cases[index] for index in order]
    results = []
    first = time.monotonic()

    def work(case):
        begin = time.monotonic()
        if options.budget is not None and begin - first > options.budget:
            return
        outcome = execute(case, folder / case.name, options.seed)
        seconds = time.monotonic() - begin
        problems = judge(case, outcome)
        results.append(
            {
                'name': case.name,
                **asdict(case),
                'exit_code': outcome.code,
                'seconds': round(seconds, 1),
                'ended_after': round(outcome.ended_after, 1),
                'problems': problems,
            }
        )
        word = 'FAILED' if problems else 'passed'
        text = f'{word} {case.name}: exit code {outcome.code}, {seconds:.0f} s'
        print('\n  '.join([text, *problems]), flush=True)
        if options.json is not None:
            content = summary(list(results), options.seed, len(cases) - len(results))
            name = f'{options.json.name}.{os.getpid()}.{len(results)}.part'
            part = options.json.with_name(name)
            part.write_text(json.dumps(content, indent=1), encoding='utf-8')
            part.replace(options.json)

    with ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(work, cases))
    return results


def main(arguments=None):
    options = build_parser().parse_args(arguments)
    try:
        cases = chosen_cases(options.case)
        if options.out is not None and options.out.exists() and any(options.out.iterdir()):
            raise ValueError(f'--out: {options.out} is not empty, allowed is a new folder')
    except (ValueError, OSError) as error:
        print(f'error: {error}', file=sys.stderr)
        return WRONG_INPUT
    if options.list:
        print('\n'.join(case.name for case in cases))
        return PASSED
    with tempfile.TemporaryDirectory(prefix='maasi_chaos_') as temporary:
        folder = Path(temporary) if options.out is None else options.out.resolve()
        try:
            results = run_all(cases, folder, options)
        except KeyboardInterrupt:
            print('error: interrupted', file=sys.stderr)
            return INTERRUPTED
    passed = sum(not item['problems'] for item in results)
    left_out = len(cases) - len(results)
    print(
        f'{passed} of {len(results)} cases passed'
        + (f', {left_out} were left out: --budget' if left_out else '')
    )
    return PASSED if passed == len(results) else FAILED


if __name__ == '__main__':
    sys.exit(main())

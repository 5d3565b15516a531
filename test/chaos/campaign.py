"""The command of the fault campaign: selects cases, runs them, summarises the results."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from chaos_cases import Case, all_cases
from chaos_execution import execute
from chaos_verdict import judge

from maasi_sim.arguments import Parser, count, whole

PASSED, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130
_SEED = 1
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class Result:
    """Result of a case; `problems` is empty if it passed."""

    case: Case
    code: int | None
    seconds: float
    ended_after: float
    problems: list[str]

    @property
    def passed(self) -> bool:
        """Whether all guarantees held."""
        return not self.problems


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(
        prog='chaos',
        description='Run scenarios in which nodes are killed or hang, and check the results: '
        'exit code, robots at rest, found targets, recording, report, processes.',
        epilog='Exit codes: 0 all cases passed, 1 some did not, 2 wrong input, 130 interrupted.',
    )
    parser.add_argument('--list', action='store_true', help='list all cases and exit')
    parser.add_argument(
        '--case', nargs='+', action='extend', metavar='NAME', help='only these; * is a wildcard'
    )
    parser.add_argument('--seed', type=whole, default=_SEED, metavar='N', help='of all runs')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the results')
    parser.add_argument(
        '--out', type=Path, metavar='DIR', help='keep the runs (default: a temporary folder)'
    )
    parser.add_argument(
        '--jobs', type=count, default=1, metavar='N', help='cases in parallel (default: 1)'
    )
    parser.add_argument(
        '--budget',
        type=float,
        metavar='S',
        help='wall time after which no case is started; the order then mixes all kinds [s]',
    )
    return parser


def chosen_cases(names: Sequence[str] | None) -> list[Case]:
    """Return the cases of some names or patterns; a pattern without any is a ValueError."""
    cases = all_cases()
    for name in names or ():
        if not any(fnmatchcase(case.name, name) for case in cases):
            raise ValueError(f'--case: read {name!r}, allowed are those of --list')
    chosen = names or ['*']
    return [case for case in cases if any(fnmatchcase(case.name, name) for name in chosen)]


def run_case(case: Case, folder: Path, seed: int) -> Result:
    """Run and check a case."""
    begin = time.monotonic()
    outcome = execute(case, folder / case.name, seed)
    seconds = time.monotonic() - begin
    return Result(case, outcome.code, seconds, outcome.ended_after, judge(case, outcome))


def summary(results: Sequence[Result], seed: int, left_out: int) -> dict[str, Any]:
    """Return the results as plain values."""
    counts: dict[str, Counter[str]] = {}
    for item in results:
        case = item.case
        mode = 'lockstep' if case.lockstep else 'free'
        reaction = 'respawn' if case.respawn else 'end'
        number = 'two' if len(case.nodes) > 1 else 'one'
        kind = f'{case.kind} {mode} {reaction} {case.fault} {case.when} {number}'
        counts.setdefault(kind, Counter())['passed' if item.passed else 'failed'] += 1
    return {
        'seed': seed,
        'passed': sum(item.passed for item in results),
        'failed': sum(not item.passed for item in results),
        'left_out': left_out,
        'counts': {kind: dict(counter) for kind, counter in counts.items()},
        'cases': [
            {
                'name': item.case.name,
                **asdict(item.case),
                'exit_code': item.code,
                'seconds': round(item.seconds, 1),
                'ended_after': round(item.ended_after, 1),
                'problems': item.problems,
            }
            for item in results
        ],
    }


def run_all(
    cases: Sequence[Case],
    folder: Path,
    seed: int,
    jobs: int = 1,
    budget: float | None = None,
    file: Path | None = None,
) -> list[Result]:
    """Run cases, print each result, and write all results after each."""
    if budget is not None:
        # Spread evenly over the list, wherever the budget ends it.
        order = sorted(range(len(cases)), key=lambda index: (index * _GOLDEN) % 1.0)
        cases = [cases[index] for index in order]
    results: list[Result] = []
    begin = time.monotonic()

    def work(case: Case) -> None:
        if budget is not None and time.monotonic() - begin > budget:
            return
        result = run_case(case, folder, seed)
        results.append(result)
        word = 'passed' if result.passed else 'FAILED'
        text = f'{word} {case.name}: exit code {result.code}, {result.seconds:.0f} s'
        print('\n  '.join([text, *result.problems]), flush=True)
        if file is not None:
            content = summary(list(results), seed, len(cases) - len(results))
            part = file.with_name(f'{file.name}.{os.getpid()}.{len(results)}.part')
            part.write_text(json.dumps(content, indent=1), encoding='utf-8')
            part.replace(file)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(work, cases))
    return results


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
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
            results = run_all(
                cases, folder, options.seed, options.jobs, options.budget, options.json
            )
        except KeyboardInterrupt:
            print('error: interrupted', file=sys.stderr)
            return INTERRUPTED
    passed = sum(item.passed for item in results)
    left_out = len(cases) - len(results)
    print(
        f'{passed} of {len(results)} cases passed'
        + (f', {left_out} were left out: --budget' if left_out else '')
    )
    return PASSED if passed == len(results) else FAILED


if __name__ == '__main__':
    sys.exit(main())

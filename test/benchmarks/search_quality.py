"""Quality of whole searches with each planner, side by side: `./scripts/search_quality`.

Compares the planners in the regimes of `search_regimes.py` and prints tables in Markdown. Seeds
are those of `quality_conditions.py`: numbers for documents are from the block `report`, which
nothing is tuned on.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from quality_conditions import wanted
from search_regimes import KINDS, REGIMES, prepared

from maasi_sim.experiments.campaign import carry_out_all, plan, run_command
from maasi_sim.experiments.experiment import Case, Experiment
from maasi_sim.experiments.searches import comparison_of, search_settings
from maasi_sim.experiments.tables import SearchTable

# What differences are to.
REFERENCE = 'before'
BEGIN, END = '<!-- table: begin -->', '<!-- table: end -->'


def comparison(regime: str, kinds: Sequence[str]) -> Experiment:
    """Return the comparison of a regime; the reference stands first."""
    cases = []
    for kind in sorted(kinds, key=lambda name: name != REFERENCE):
        how = KINDS[kind]
        settings = search_settings(prepared(regime, kind), how.maker)
        cases.append(Case(kind, settings, runs=how.runs))
    return comparison_of(regime, cases)


def write(path: Path, text: str) -> None:
    before, rest = path.read_text(encoding='utf-8').split(BEGIN)
    after = rest.split(END)[1]
    path.write_text(f'{before}{BEGIN}\n{text}{END}{after}', encoding='utf-8')


def main() -> int:
    parser = argparse.ArgumentParser(prog='search_quality', description=__doc__)
    parser.add_argument('--planner', nargs='*', choices=tuple(KINDS), default=list(KINDS))
    parser.add_argument(
        '--out',
        type=Path,
        default=Path('runs/search_quality'),
        metavar='DIR',
        help='folder of the runs; those there are kept',
    )
    parser.add_argument('--document', type=Path, metavar='FILE', help='write the tables into it')
    options, regimes, seeds = wanted(parser, REGIMES, runs=16, jobs=os.cpu_count() or 1)
    plans = [
        plan(comparison(regime, options.planner), options.out, len(seeds), first=seeds[0])
        for regime in regimes
    ]
    problems = carry_out_all(plans, max(options.jobs, 1))
    text = '\n'.join(
        f'**{name}** (limit {REGIMES[name].limit:g} s)\n\n{SearchTable(work.results()).markdown()}'
        for name, work in zip(regimes, plans)
    )
    head = f'Block `{options.seeds}`, the first {options.runs} seeds (fewer for slow planners).\n'
    print(f'{head}\n{text}')
    if options.document is not None:
        write(options.document, f'{head}\n{text}')
    return 1 if problems else 0


if __name__ == '__main__':
    sys.exit(run_command(main))

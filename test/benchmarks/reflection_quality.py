"""What searches leave, and take for targets, among reflections: `./scripts/quality reflections`.

Each reflection is a fixed position without a target that answers with 0.3 of pi.
"""

import numpy as np
from quality_conditions import reflections, with_returns
from search_quality import prepared

from maasi_sim.experiments.campaign import make_workers
from maasi_sim.search import search

# By name: regime, planner, and number of reflections.
CONDITIONS = {
    f'{regime}, {planner}, {number} reflections': (regime, planner, number)
    for regime, planner in (
        ('30 squares, box, 3', 'lawnmower'),
        ('30 squares, box, 10, prior', 'tour'),
    )
    for number in (0, 4)
}
HEAD = (
    *('condition', 'runs', 'complete', 'targets left'),
    *('left, detected in half of five looks or more', 'reflections found'),
)
MARGIN = 0.05  # of the side of the area, without reflections
LEAST_LOOKS, LEAST_DETECTED = 5, 0.5


def run_one(key):
    """Return whether all was found, and the numbers of the table; key: seed and case."""
    seed, (regime, kind, number) = key
    scenario = prepared(regime, kind)
    counts = {}

    def returned(sensor, pose, step, values, causes):
        detection, targets = sensor.sensor.detection, sensor.targets[:, : values.shape[1]]
        looks, detected = counts.setdefault('all', np.zeros((2, len(targets))))
        looks += detection.probability(targets, pose) > 0.5 * detection.gain
        np.add.at(detected, causes[causes >= 0], 1.0)
        low, high = sensor.bounds.T
        low, high = low + MARGIN * (high - low), high - MARGIN * (high - low)
        return reflections(sensor, pose, step, values, causes, number, low, high)

    with with_returns(returned):
        result = search(scenario, seed)
    match = result.scores.match
    looks, detected = counts['all']
    clear = (looks >= LEAST_LOOKS) & (detected >= LEAST_DETECTED * looks)
    left = np.ones(len(looks), bool)
    left[[j for _, j in match.pairs]] = False
    return (
        not left.any(),
        left.sum(),
        len(left),
        (left & clear).sum(),
        clear.sum(),
        match.false_found,
    )


def rows(conditions, seeds, jobs):
    """Yield a row for each condition."""
    workers = make_workers(len(seeds), jobs)
    try:
        for name in conditions:
            keys = [(seed, CONDITIONS[name]) for seed in seeds]
            runs = np.array([run for _, run in workers.make(run_one, keys)], int)
            whole, left, every, missed, clear, false = runs.sum(axis=0)
            number = CONDITIONS[name][2] * len(runs)
            answers = f'{false} of {number}' if number else f'{false} false targets'
            yield (
                name,
                str(len(runs)),
                f'{whole}/{len(runs)}',
                f'{left} of {every}',
                f'{missed} of {clear}',
                answers,
            )
    finally:
        workers.close()

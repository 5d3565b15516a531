"""The files of a report, and the common part of all reports."""

import contextlib
import json
import math
import tempfile
from pathlib import Path
from typing import Any

from maasi_filter.wording import number
from maasi_sim.machine import this_machine
from maasi_sim.run.log import RunRecord
from maasi_sim.run.mission import Mission
from maasi_sim.run.run_folder import ResultsError, remove, write_text, write_whole

REPORT_VERSION = 1  # format version of `report.json`, see `report.schema.json`

END_REASONS = {
    'all_found': 'all targets found',
    'planner_done': 'the planner expects no further finds',
    'time_limit': 'time limit reached',
    'interrupted': 'interrupted',
    'node_died': 'a node died',
    'node_hung': 'a node hung',
    'not_ready': 'the nodes did not become ready',
    'no_robot': 'no robot can continue',
}
MISSION_REASONS: dict[tuple[str, str], str] = {}  # replaces those of a mission


def whole_report(record: RunRecord, mission: str, content: dict[str, Any]) -> dict[str, Any]:
    """Return a report with the mission's content; infinite numbers are None."""
    wall = record.wall_time
    return {
        'version': REPORT_VERSION,
        'mission': mission,
        'scenario': record.name,
        'seed': record.seed,
        'planner': record.scenario.planner.name,
        'agents': record.scenario.names(),
        **content,
        'distance': {name: finite(length) for name, length in record.distance.items()},
        'end_reason': record.end_reason,
        'wall_time': wall,
        'real_time_factor': record.end_time / wall if wall > 0.0 else None,
        'machine': this_machine(),
        'events': record.events,
    }


def finite(value: float) -> float | None:
    """Return a number, or None if it is not finite."""
    return float(value) if math.isfinite(value) else None


def reason_of_end(report: dict[str, Any]) -> str:
    """Return the reason why a run ended, as text."""
    reason = report['end_reason']
    return MISSION_REASONS.get((report['mission'], reason)) or END_REASONS.get(reason, reason)


def summary(report: dict[str, Any], found: str, counts: str) -> str:
    """Return a report in a few lines: finds, counts and speed."""
    lines = [f'{found} (ended: {reason_of_end(report)})', counts]
    if factor := report['real_time_factor']:
        lines.append(f'{report["wall_time"]:.1f} s of wall time, {number(factor)} x real time')
    return '\n'.join(lines)


def write_report(mission: Mission[Any], record: RunRecord, folder: Path) -> dict[str, Any]:
    """Write report, picture and further files into a folder; return the report."""
    report = mission.report(record)
    text = json.dumps(report, indent=2, allow_nan=False)
    write_text(folder / 'report.json', text + '\n')
    for name, content in mission.tables(record).items():
        write_text(folder / name, content)
    figure = mission.figure(record)
    write_whole(folder / 'report.png', lambda path: figure.savefig(path, dpi=110))
    return report


def store_report(
    mission: Mission[Any], record: RunRecord, folder: Path
) -> tuple[dict[str, Any], Path | None, str]:
    """Write a report into the run's folder, or elsewhere if that fails.

    Elsewhere: temporary files, home, `/dev/shm`. Returns the report, its folder (None: not
    written), and why it is not in the run's folder.
    """
    problem = ''
    for base in (None, Path(tempfile.gettempdir()), Path.home(), Path('/dev/shm')):
        try:
            place = Path(tempfile.mkdtemp(prefix='maasi_report_', dir=base)) if base else folder
        except OSError:
            continue
        try:
            return write_report(mission, record, place), place, problem
        except (OSError, ResultsError) as error:
            cause = error.__cause__ or error
            reason = getattr(cause, 'strerror', None) or str(error)
            problem = problem or f'{folder}: cannot write the report: {reason}'
            remove(place / 'report.json')
            if base is not None:
                with contextlib.suppress(OSError):
                    place.rmdir()
    return mission.report(record), None, problem

"""A search whose planner gives up is no success, also where the scenario stops there."""

import pytest
from scenario_runs import run_scenario, write_scenario

pytestmark = pytest.mark.system
# A planner that expects nothing of the first position on.
HOPELESS = """
from maasi_planner.planners.nearest_widest import NearestWidest


class Hopeless(NearestWidest):
    def finished(self, team):
        return 'no position is worth a visit'
"""


def test_a_search_that_gives_up_at_once_ends_with_1_and_says_what_is_explored(tmp_path):
    (tmp_path / 'hopeless.py').write_text(HOPELESS)
    scenario = write_scenario(
        tmp_path / 'search.yaml',
        [[0.0, 0.0]],
        planner={'name': 'hopeless:Hopeless'},
        stop='planner_done',
    )
    run = run_scenario(scenario, tmp_path / 'run', '--lockstep')
    assert run.code == 1, run.output
    reason = 'ended: no position is worth a visit; '
    (line,) = (line for line in run.output.splitlines() if line.startswith(reason))
    assert line.endswith(' % explored')
    assert run.report['end_reason'] == 'planner_done'
    # What the search takes is printed before it starts.
    lines = run.output.splitlines()
    assert lines[0] == 'area: 7.29 m2' and lines[2].startswith('team: one pass takes ')
    assert next(i for i, text in enumerate(lines) if text.startswith('search: seed')) > 2

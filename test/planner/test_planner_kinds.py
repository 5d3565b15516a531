"""Every kind of planner in the planner node, over real topics."""

import pytest
from test_planner_node import ROBOTS, SETTINGS, begin, running


@pytest.mark.parametrize('name', ['asi', 'as', 'nearest_widest', 'lawnmower'])
def test_every_planner_sends_all_robots_and_measures_again_after_their_measurements(name):
    planner = SETTINGS.planner.model_copy(update={'name': name})
    with running(planner=planner, others={}) as (node, team, until):
        begin(node, team, until)
        assert {decision.planner for decision in team.decisions} == {name}
        until(lambda: team.batches)
        batch = team.batches[-1]
        team.update(batch.id, batch.members)
        for step in (20, 30):
            for robot in ROBOTS:
                team.state(robot, step)
            until(lambda step=step: {item.step for item in node._heard.values()} == {step})
        # Both measure again where they come to be, before they have reached their waypoints.
        until(lambda: team.batches[-1].id > batch.id)

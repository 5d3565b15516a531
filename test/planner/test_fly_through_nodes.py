"""Free running: goals that preempt one another, and robots whose planner dies meanwhile."""

import numpy as np
from driven_team import driven
from test_planner_node import SETTINGS

from maasi_msgs.msg import AgentState

# A grid of 0.5 m: they are always near a waypoint, and turn to the next one.
ROBOTS = {
    name: robot.model_copy(
        update={'motion': robot.motion.model_copy(update={'arrival_radius': 0.2})}
    )
    for name, robot in SETTINGS.robots.items()
}


def test_robots_whose_planner_dies_while_they_pass_a_waypoint_stop_at_the_last_one():
    with driven(robots=ROBOTS) as world:
        a = world.robots['a']
        world.until(lambda: a.moves and a.state.goal_id >= 3)
        # It has passed two waypoints, and never stood.
        statuses = {state.goal_status for state in a.states if 0 < state.goal_id < 3}
        assert statuses == {AgentState.MOVING}
        last = next(
            robot
            for decision in reversed(world.decisions)
            for robot in decision.robots
            if robot.robot == 'a'
        )
        world.end_planner()
        world.until(world.standing)
        assert a.state.goal_status == AgentState.REACHED
        point = last.waypoint
        assert np.hypot(a.place[0] - point.x, a.place[1] - point.y) < 0.06


def test_a_robot_that_refuses_the_next_waypoint_is_stopped_and_planned_anew():
    with driven(robots=ROBOTS) as world:
        a = world.robots['a']
        world.until(lambda: a.moves)
        goals = world.drivers[0].goals
        problem, refused = goals.problem, []

        def refuses(request):
            if not refused:
                refused.append(int(request.goal_id))
                return 'tested'
            return problem(request)

        goals.problem = refuses
        world.until(lambda: refused and a.moves and a.state.goal_id > refused[0])
        stopped = [state.goal_status for state in a.states if state.goal_id == refused[0] - 1]
        assert AgentState.CANCELED in stopped
        assert not world.logged('of another client')

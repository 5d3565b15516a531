"""Free running: goals that preempt one another, and robots whose planner dies meanwhile."""

import threading

import pytest
from driven_team import SETTINGS, driven
from waiting import wait_until

from maasi_msgs.msg import AgentState


@pytest.fixture
def world():
    """Run robots on a grid of 0.5 m that turn 0.2 m before each waypoint: often."""
    robots = {
        name: robot.model_copy(
            update={'motion': robot.motion.model_copy(update={'arrival_radius': 0.2})}
        )
        for name, robot in SETTINGS.robots.items()
    }
    with driven(robots=robots) as made:
        made.until(made.moving)
        yield made


def test_robots_whose_planner_dies_while_they_pass_a_waypoint_stop_at_the_last_one(world):
    a = world.robots['a']

    def passed():
        """Return how many waypoints it did not stop at; on a busy machine a decision is late."""
        stopped = {state.goal_id for state in a.states if state.goal_status != AgentState.MOVING}
        return len(set(range(1, a.state.goal_id)) - stopped)

    world.until(lambda: a.moves and passed() >= 2)
    robots = [robot for decision in world.decisions for robot in decision.robots]
    last = [robot.waypoint for robot in robots if robot.robot == 'a'][-1]
    world.end_planner()
    world.until(world.standing)
    assert a.state.goal_status == AgentState.REACHED
    assert a.is_near(last.x, last.y, 0.06)


def test_a_planner_that_ends_stops_robots_whose_next_goal_is_on_its_way(world):
    def turn():
        """Do a step of the robots, up to a goal that no driver has answered yet."""
        world.step += 1
        for robot in world.robots.values():
            robot.move(world.step)
        for _ in range(10):
            if not world.planner.goals.waiting:
                world.executor.spin_once(timeout_sec=0.001)
                world.own.spin_once(0.001)

    def cancelled():
        places = [robot.place for robot in world.robots.values()]
        world.until(world.standing)
        for robot, place in zip(world.robots.values(), places, strict=True):
            assert robot.state.goal_status == AgentState.CANCELED
            assert robot.is_near(*place[:2], 0.3)

    wait_until(lambda: world.planner.goals.waiting, turn)
    # The drivers answer after that.
    for transition in ('deactivate', 'cleanup'):
        assert getattr(world.planner, f'trigger_{transition}')().name == 'SUCCESS'
    cancelled()
    for transition in ('configure', 'activate'):
        assert getattr(world.planner, f'trigger_{transition}')().name == 'SUCCESS'
    world.until(world.moving)
    wait_until(lambda: world.planner.goals.waiting, turn)
    # As its process does it; the drivers answer meanwhile.
    planner = world.planner
    end = threading.Thread(target=lambda: (planner.halt(), world.end_planner()))
    end.start()
    while end.is_alive():
        world.executor.spin_once(timeout_sec=0.01)
    cancelled()


def test_robots_that_refuse_waypoints_are_stopped_and_planned_for_again(world, monkeypatch):
    a, goals = world.robots['a'], world.drivers[0].goals
    problem, refused = goals.problem, []

    def refuses(request):
        if not refused:
            refused.append(int(request.goal_id))
            return 'tested'
        return problem(request)

    # One that refuses the next waypoint is stopped, and gets another one.
    monkeypatch.setattr(goals, 'problem', refuses)
    world.until(lambda: refused and a.moves and a.state.goal_id > refused[0])
    stopped = [state.goal_status for state in a.states if state.goal_id == refused[0] - 1]
    assert AgentState.CANCELED in stopped
    assert not world.logged('of another client')
    # Robots that refuse every goal are an error.
    monkeypatch.setattr('maasi_planner.planner_node._REFUSAL_PATIENCE', 1.0)
    with monkeypatch.context() as patch:
        for driver in world.drivers:
            patch.setattr(driver.goals, 'problem', lambda request: 'tested')
        world.until(lambda: world.planner.fault().startswith('no goal accepted for '))
    world.until(lambda: world.moving() and not world.planner.fault())
    # A driver that is ended is no warning.
    warnings, sent = [], world.planner.goals._sent['b']
    monkeypatch.setattr(world.planner.goals, '_warn', lambda _, text: warnings.append(text))
    assert world.drivers[1].trigger_deactivate().name == 'SUCCESS'
    world.until(lambda: sent.reason == 'the driver stops')
    assert warnings == []

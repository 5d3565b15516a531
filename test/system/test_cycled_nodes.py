"""Nodes are cycled during a search, each transition as soon as the last one has answered."""

import os
import signal

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from scenario_runs import Operator, alongside, start

from maasi_msgs.msg import FilterUpdate

pytestmark = pytest.mark.system
CYCLE = (
    Transition.TRANSITION_DEACTIVATE,
    Transition.TRANSITION_CLEANUP,
    Transition.TRANSITION_CONFIGURE,
    Transition.TRANSITION_ACTIVATE,
)
# How often each node is cycled; MAASI_CYCLES takes another number for all.
DEMO = {
    '/planner_node': 20,
    '/filter_node': 5,
    '/mambo/driver': 5,
    '/turtlebot/guard': 5,
    '/turtlebot/driver': 5,
    '/sim_node': 3,
}
OTHERS = {
    'ranging_drone_3d': {'/drone/driver': 5},
    'drone_rov': {'/drone/driver': 3, '/rov/driver': 3},
    'buildings_one': {'/red/cuboid_planner': 5, '/sim_node': 3},
}


class Cycler(Operator):
    run = None

    def until(self, condition, what):
        super().until(lambda: condition() or self.run.process.poll() is not None, what)
        assert self.run.process.poll() is None, f'{what}: the run has ended'

    def cycle(self, name, times):
        client = self.node.create_client(ChangeState, f'{name}/change_state')
        self.until(client.service_is_ready, f'{name} is not there')
        for number in range(times):
            for transition in CYCLE:
                request = ChangeState.Request()
                request.transition.id = transition
                future = client.call_async(request)
                where = f'{name}, cycle {number}, transition {transition}'
                self.until(future.done, f'{where}: no answer')
                assert future.result().success, where

    def collect(self, kind, topic):
        received = []
        subscription = self.node.create_subscription(kind, topic, received.append, 10)
        self.until(lambda: received, f'nothing on {topic}')
        self.node.destroy_subscription(subscription)


@pytest.mark.parametrize('scenario, cycles', [('mambo_turtlebot', DEMO), *OTHERS.items()])
def test_nodes_survive_cycles_back_to_back_and_the_search_goes_on(tmp_path, scenario, cycles):
    options = ('--no-record', '--rate', 1, '--time-limit', 3000)
    with (
        alongside(Cycler) as cycler,
        start(scenario, tmp_path / 'run', *cycler.options, *options) as run,
    ):
        cycler.run = run
        searches = not scenario.startswith('buildings')
        if searches:
            cycler.collect(FilterUpdate, 'filter_update')
        for name, times in cycles.items():
            cycler.cycle(name, int(os.environ.get('MAASI_CYCLES', times)))
        if searches:
            cycler.collect(FilterUpdate, 'filter_update')
        run.process.send_signal(signal.SIGINT)
        # Interrupted; 3 if a node had died.
        assert run.finish().code == 130, run.output
        assert not run.bag.exists()

"""The far end of a Mambo's link in a scenario, and what a scenario may say about it."""

import time
from copy import deepcopy

import pytest
from numpy.testing import assert_allclose
from waiting import wait_until

from maasi_drivers.links.mambo.link import MamboLink
from maasi_sim.emulators.linked_robots import linked_robot, with_addresses
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.scenario.schema import ScenarioError

MAMBO = {
    'type': 'mambo',
    'link': 'mambo_wifi',
    'mambo': {'arm': True, 'full_speed': 1.97, 'ground': 0.1},
    'start': [0.2, 0.6, 0.6],
    'yaw': 0.5,
    'candidates': {'grid': [2, 2], 'spacing': 0.5, 'corner': [0.0, 0.0]},
}


def scenario(**robots):
    content = {
        'version': 1,
        'environment': {'bounds': [[-0.3, 1.2], [-0.3, 1.2]]},
        'targets': {'positions': [[0.5, 0.5]]},
        'robots': deepcopy(robots),
    }
    return scenario_from_values(content, 'test')


def test_it_stands_below_its_start_and_flies_as_its_link_says():
    robot = with_addresses(scenario(mambo=MAMBO)).robots['mambo']
    drone = linked_robot('mambo', robot, 1)
    link = MamboLink('wifi', robot.mambo.address, robot.mambo.port)
    link.connect()
    try:
        wait_until(lambda: link.connected)
        assert_allclose(drone.state.pose.position, [0.2, 0.6, 0.1])
        assert drone.state.pose.yaw == pytest.approx(0.5)
        assert not drone.obeys
        link.take_off()
        wait_until(lambda: link.flying_state == 'hovering')
        assert drone.obeys
        assert_allclose(drone.state.pose.position, [0.2, 0.6, 0.5], atol=0.15)
        drone.cut()
        # Nothing is heard any more; its firmware has it hover.
        wait_until(lambda: time.monotonic() - link.heard_at > 1.0)
        assert drone.obeys
        drone.cut(False)
        link.land()
        wait_until(lambda: link.flying_state == 'landed')
        assert not drone.obeys
    finally:
        link.close()
        drone.close()


def test_each_drone_has_an_address_of_this_host():
    other = MAMBO | {'mambo': MAMBO['mambo'] | {'address': '127.0.0.9', 'port': 5555}}
    robots = with_addresses(scenario(mambo=MAMBO, other=other)).robots
    first, second = robots['mambo'].mambo, robots['other'].mambo
    assert first.address.startswith('127.') and first.address != '192.168.99.3'
    assert first.arm and first.ground == 0.1
    # One that was asked for stays.
    assert (second.address, second.port) == ('127.0.0.9', 5555)


@pytest.mark.parametrize(
    ('changes', 'text'),
    [
        ({'mambo': {'arm': False}}, 'mambo.arm: read false, allowed is true'),
        ({'mambo': {'arm': True}}, 'mambo.full_speed: is missing'),
        ({'mambo': None}, r'mambo: is missing, .* at least \{arm: true'),
        ({'mambo': {'arm': True, 'pose': 'pose'}}, "mambo.pose: read 'pose'"),
        ({'start': [0.2, 0.6, 0.0]}, 'start: read height 0.0'),
        ({'guard': True}, 'guard: read true'),
        ({'driver': 'turtlebot_driver'}, "link: read 'mambo_wifi', but driver 'turtlebot_driver'"),
        ({'motion': {'model': 'constant_speed'}}, "motion.model: read 'constant_speed'"),
    ],
)
def test_what_cannot_be_is_said_before_anything_starts(changes, text):
    with pytest.raises(ScenarioError, match=text):
        scenario(mambo=MAMBO | changes)

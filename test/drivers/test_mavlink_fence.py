"""The area of a search as the fence of an autopilot, against a fake one."""

import numpy as np
import pytest
from mavlink_play import ARM, HEIGHTS, Play, mavlink
from numpy.testing import assert_allclose

from maasi_drivers.links.mavlink.fence import fence_items
from maasi_drivers.links.mavlink.phases import VehiclePhase
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import OriginSettings, to_map
from maasi_filter.geometry.operating_volume import MARGIN, OperatingVolume

INSIDE = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
OUTSIDE = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
ROUND = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION
ORIGIN = OriginSettings(latitude=47.4, longitude=-8.55)
BORDER = [[-60.0, -40.0], [60.0, -50.0], [70.0, 45.0], [-55.0, 40.0]]
POND = [[10.0, 10.0], [20.0, 10.0], [15.0, 20.0]]
BARN = [[-30.0, -20.0], [-20.0, -20.0], [-20.0, -10.0], [-30.0, -10.0]]
WELL = {'centre': [40.0, -10.0], 'radius': 4.1}
VERIFIED = 'fence: uploaded and verified, 12 vertices and circles'
BOX = np.array([[-8.0, 8.0], [-6.0, 6.0], [0.0, 5.0]])


def items_of(keep_outs=(BARN, WELL), area=(BORDER, POND), start=(0.0, 0.0, 2.0)):
    values = {'area': area} if area else {'bounds': BOX[:2].tolist()}
    values['origin'] = ORIGIN
    environment = EnvironmentSettings.model_validate(values | {'keep_outs': list(keep_outs)})
    limits = BOX + np.array([MARGIN, -MARGIN])
    return fence_items(OperatingVolume(Area(environment), 0.2, limits), list(start))


def play_of(firmware='arducopter', items=None, **changes):
    play = Play(firmware, **changes)
    play.vehicle.fence.begin(items or items_of())
    return play


def has(play, items):
    """Return whether the autopilot keeps these items, up to the rounding of a radius."""
    kept = play.autopilot.fence.items
    return len(kept) == len(items) and np.allclose(kept, items, rtol=0.0, atol=1e-5)


def on_map(items):
    """Return latitudes and longitudes as positions on the map."""
    return to_map(1e-7 * np.array([item[:1:-1] for item in items], dtype=float), ORIGIN)


@pytest.mark.parametrize('firmware', HEIGHTS)
def test_the_fence_is_uploaded_and_read_back_before_it_is_armed(firmware):
    play = play_of(firmware).fly()
    kept = play.autopilot.fence.items
    assert [item[0] for item in kept] == [INSIDE] * 4 + [OUTSIDE] * 7 + [ROUND]
    assert [item[1] for item in kept] == pytest.approx([4] * 4 + [3] * 3 + [4] * 4 + [4.1])
    corners = np.array([*BORDER, *POND, *BARN, WELL['centre']])
    # 1e-7 degrees are 1.1 cm.
    assert_allclose(sorted(on_map(kept).tolist()), sorted(corners.tolist()), atol=0.02)
    assert play.said.count(VERIFIED) == 1
    sent = play.to_autopilot.messages
    assert sent.index(play.sent('MISSION_ACK')[0]) < sent.index(play.commands(ARM)[0])


def test_a_box_and_the_part_of_an_area_at_the_start():
    box = items_of(keep_outs=[], area=None)
    assert [item[:2] for item in box] == [(INSIDE, 4)] * 4
    assert_allclose([on_map(box).min(axis=0), on_map(box).max(axis=0)], BOX[:2].T, atol=0.02)
    # Of two islands, as no path leads to the other one.
    parts = 'MULTIPOLYGON (((0 0, 9 0, 9 9, 0 0)), ((20 0, 29 0, 29 9, 20 9, 20 0)))'
    assert [item[:2] for item in items_of([], parts, [22.0, 4.0])] == [(INSIDE, 4)] * 4


def test_without_the_protocol_that_is_said_and_it_flies():
    play = play_of()
    play.autopilot.capabilities = 0
    play.fly()
    assert 'not uploaded: the autopilot does not support it' in play.said
    assert not play.sent('MISSION_COUNT') and play.autopilot.fence.items == []


def moved(fence):
    """Move one corner by 3 cm."""
    command, number, latitude, longitude = fence.items[5]
    fence.items[5] = command, number, latitude, longitude + 4


def opened(fence):
    fence.items[4:7] = []


def without_space(fence):
    fence.most = 11


@pytest.mark.parametrize(
    ('flaw', 'reason'),
    [
        (moved, 'not verified: item 5'),
        (opened, 'not verified: the number'),
        (without_space, 'not verified (MAV_MISSION_NO_SPACE)'),
        (None, 'not verified (no answer)'),
    ],
)
@pytest.mark.parametrize('in_air', [False, True])
def test_where_it_has_another_fence_it_is_not_armed_and_takes_no_goals(flaw, reason, in_air):
    play = play_of(permitted=False)
    fence, spoilt = play.autopilot.fence, [not in_air]

    take = fence.handle

    def handle(message, now):
        kind = message.get_type()
        if spoilt[0] and flaw is without_space:
            flaw(fence)
        if not spoilt[0] or flaw is not None or kind == 'MISSION_REQUEST_LIST':
            take(message, now)
        if spoilt[0] and flaw in (moved, opened) and fence.items and kind == 'MISSION_ITEM_INT':
            flaw(fence)

    fence.handle = handle
    if in_air:
        play.run(4.0).permitted().fly()
        play.reports.clear()
        spoilt[0] = True
        play.vehicle.fence.begin()
    play.run(16.0)
    assert f'fence {reason}' in play.fault
    assert play.said.count(f'fence: {reason}') == 1
    if in_air:
        assert play.phase is VehiclePhase.FLYING and play.autopilot.armed
    else:
        assert f'fence {reason}' in play.permit()
        play.run(5.0)
        assert not play.commands(ARM)
    # It is tried again.
    spoilt[0], fence.most = False, 84
    play.until(lambda: VERIFIED in play.said)
    assert in_air or play.permit() == ''
    play.fly()
    assert play.fault == ''


def test_other_keep_outs_are_uploaded_in_flight_and_after_a_restart():
    play = play_of().fly()
    other = items_of(keep_outs=[WELL])
    play.vehicle.fence.begin(other)
    # A second change during the upload of the first.
    play.run(0.1)
    last = items_of(keep_outs=[BARN])
    play.vehicle.fence.begin(last)
    play.run(5.0)
    assert has(play, last) and play.fault == ''
    assert 'uploaded and verified, 11 vertices and circles' in play.said
    assert VERIFIED not in play.said.split('uploaded and verified, 11')[1]
    ground = play_of(permitted=False).run(4.0)
    ground.autopilot.fence.items = []
    ground.autopilot.restart()
    ground.run(6.0)
    assert has(ground, items_of()) and ground.said.count(VERIFIED) == 2


@pytest.mark.parametrize('seed', range(900, 910))
def test_messages_that_are_lost_are_sent_again(seed):
    play = play_of(permitted=False)
    generator, lost = np.random.default_rng(seed), [0]
    for wire in (play.to_driver, play.to_autopilot):

        def read(whole=wire.read):
            received = whole()
            kept = [
                item
                for item in received
                if not item.get_type().startswith('MISSION') or generator.uniform() > 0.2
            ]
            lost[0] += len(received) - len(kept)
            return kept

        wire.read = read
    play.until(lambda: 'fence: ' in play.said, limit=120.0)
    assert VERIFIED in play.said and has(play, items_of()) and lost[0] > 3

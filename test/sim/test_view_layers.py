"""What lies on the map and below its time line: belief, the unexplored, faces, strips."""

import math

import numpy as np
import pytest

from maasi_sim.run.missions import load_mission
from maasi_sim.run.view.scene import scene_of

PLANE = {'name': 'plane', 'robots': {}, 'bounds': [[0, 4], [0, 4]]}
SPACE = {'name': 'space', 'robots': {}, 'bounds': [[0, 4], [0, 4], [0, 4]]}
GREEN, BLUE, PHOTOGRAPHED = (0, 158, 115), (0, 114, 178), (47, 143, 208)


def test_the_belief_is_a_heat_map_that_can_be_switched_on_from_above_and_in_space(chromium):
    # Of two filters the one that expects more counts.
    broad = [0.0, 'filter', 'a', 0.6, [[3.0, 1.0, 0.0, 0.6, 0.25, 0.0, 0.0, 0.25, 0.0, 0.0]], 1]
    less = [0.0, 'filter', 'b', 0.1, [[3.0, 1.0, 0.0, 0.1, 0.25, 0.0, 0.0, 0.25, 0.0, 0.0]], 1]
    with chromium() as shown:
        for scene in (PLANE, SPACE):
            shown.show(scene, broad, less)
            if scene is SPACE:
                shown.page.click('#space')
                shown.settle()
            for turned in (False, True):
                if turned:
                    shown.page.click('#space')
                    shown.settle()
                # Next to the outline of the potential target, and far away.
                places = [shown.place(3.35, 1.35, 0.0), shown.place(1.0, 3.3, 0.0)]
                before = [shown.colour(*item) for item in places]
                shown.page.click('button[data-layer=clusters]')
                shown.page.click('button[data-layer=belief]')
                shown.settle()
                red, _, blue = shown.colour(*places[0])
                assert red > blue + 40
                assert shown.colour(*places[1]) == before[1]
                assert 'potential targets per area' in shown.page.inner_text('#legend')
                shown.page.click('button[data-layer=belief]')
                shown.page.click('button[data-layer=clusters]')
                shown.settle()
                assert [shown.colour(*item) for item in places] == before
                assert 'potential targets per area' not in shown.page.inner_text('#legend')
        density = shown.page.evaluate('maasi.map.belief.words([3, 1])')
        assert float(density.split()[1]) == pytest.approx(0.6 / (2 * math.pi * 0.25), rel=0.02)


def moving(sensor):
    """Return scene and events of a robot that flies from x = 1 to x = 3 in 2 s and sees."""
    events = [[0.0, 'map', '', [0, 0, 0], [0.1, 0.1, 0], [41, 41, 1], 'z' * 41 * 41, 0.0]]
    for step in range(21):
        where = [1.0 + 0.1 * step, 2.0, 1.0]
        events.append([0.1 * step, 'robot', 'rover', [*where, 0.0], 1.0, 1, ''])
        if step in (0, 10):
            events.append([0.1 * step, 'seen', 'rover', where, []])
    found = [[1, 2.0, 3.5, 0.0, [0.001, 0, 0, 0.001, 0, 0], 'rover', 0.5]]
    return {**PLANE, 'robots': {'rover': {'view': sensor}}}, [*events, [0.5, 'found', '', found]]


def test_the_dark_goes_as_the_field_of_view_moves_and_stays_away_where_it_was_measured(chromium):
    corners = {'lower': [-0.3, -0.3], 'upper': [0.3, 0.3], 'edge': 0.0}
    scene, events = moving({'kind': 'box', 'turns': True, 'gain': 0.8, **corners})
    unseen = '(x) => maasi.map.unexplored.mean(Math.round(10 * x), 20)'
    with chromium() as shown:
        shown.show(scene, *events)
        shares = {}
        for time in (0.5, 0.52, 0.54, 0.56, 1.5, 2.0):
            shown.seek(time)
            shares[time] = [
                shown.page.evaluate(f'({unseen})({x})') for x in (1.0, 1.5, 1.8, 2.2, 3.5)
            ]
        assert shares[0.5] == pytest.approx([1.0, 0.2, 0.6, 1.0, 1.0], abs=0.01)
        # Little by little while its edge passes, between two of its states.
        passing = [shares[time][2] for time in (0.5, 0.52, 0.54, 0.56)]
        assert np.all(np.diff(passing) < -0.05)
        # What it measured since the map stays; what it only passed is as the planner has it.
        assert shares[1.5][3] == pytest.approx(0.12, abs=0.01)
        assert shares[2.0] == pytest.approx([1.0, 1.0, 0.2, 0.2, 1.0], abs=0.01)
        assert shown.tip(2.0, 2.0).startswith('explored 80 %')
        # As dark as what is left.
        here, aside = (shown.colour(*shown.place(1.87, y)) for y in (2.17, 2.87))
        assert sum(here) > sum(aside) + 30


def test_the_rest_of_a_tour_is_a_thin_line_in_the_colour_of_its_robot(chromium):
    blue = {}
    for tour in ([], [[3.0, 1.0, 0.0], [3.0, 3.0, 0.0]]):
        row = ['rover', 0, 0, [2.0, 1.0, 0.0], [], '', tour]
        events = [
            [0.0, 'robot', 'rover', [1.0, 1.0, 0.0, 0.0], 1.0, 1, ''],
            [0.0, 'plan', '', 'tour', 0.0, 0.0, '', [row]],
        ]
        with chromium() as shown:
            shown.show(PLANE, *events)
            shown.seek(0.0)
            (x, low), (_, high) = shown.place(3.0, 1.2), shown.place(3.0, 2.8)
            strip = shown.pixels()[round(high) : round(low), round(x) - 3 : round(x) + 4, :3]
            near = np.abs(strip - BLUE).max(axis=2) < 150
            blue[bool(tour)] = near.any(axis=1).mean()
            assert near.all(axis=1).sum() == 0
            assert ('rest of the tour' in shown.page.inner_text('#legend')) == bool(tour)
    assert blue[False] == 0.0 and 0.2 < blue[True] < 0.8


def test_a_ring_runs_out_from_what_is_found_unless_motion_is_to_be_reduced(chromium):
    run = moving({'kind': 'exponential', 'turns': False, 'gain': 0.9, 'size': [0.3, 0.3]})
    green = {}
    for motion in ('reduce', 'no-preference'):
        with chromium(reduced_motion=motion) as shown:
            shown.show(run[0], *run[1])
            shown.page.evaluate('maasi.setPlaying(false)')
            shown.seek(0.6)
            green[motion] = shown.near(GREEN).sum()
            shown.seek(1.5)
            green[motion, 'later'] = shown.near(GREEN).sum()
    assert green['no-preference'] > green['reduce'] + 60
    assert green['reduce', 'later'] == pytest.approx(green['reduce'], abs=10)


def test_cells_say_how_unexplored_they_are_in_perspective(chromium):
    grid = [0.0, 'map', '', [0, 0, 0], [2, 2, 2], [3, 3, 3], '0' * 13 + 'n' + '0' * 13, 0.9]
    floor = [0.0, 'map', '', [0, 0, 0], [1, 1, 0], [5, 5, 1], '0' * 12 + 'z' + '0' * 12, 0.9]
    with chromium() as shown:
        shown.show(SPACE, grid)
        assert shown.page.evaluate('maasi.camera.spatial')
        assert shown.tip(2, 2, 2).startswith('explored 34 %')
        assert shown.tip(0, 2, 2) == ''
        shown.show(PLANE, floor)
        shown.page.click('#space')
        shown.settle()
        assert shown.tip(2, 2, 0).startswith('explored 0 %')
        where = shown.tip(3.3, 0.7, 0)
        assert where.startswith('explored 100 %')
        numbers = [float(item) for item in where[where.index('(') + 1 : -3].split(', ')]
        assert numbers == pytest.approx([3.3, 0.7], abs=0.02)


def test_faces_of_buildings_fill_and_what_the_log_offers_is_there(chromium):
    scene = scene_of('buildings', load_mission('buildings_four').scenario)
    owner, face, part = scene['cells'][5]
    own = [index for index, cell in enumerate(scene['cells']) if cell[:2] == [owner, face]]
    shot = [5, 150.0, 60.0, 20.0, 0.88]
    events = []
    for time, planned, shots in ((0.0, [5, 6], []), (1.0, [6], []), (2.0, [6], [shot])):
        plan = ['searching', 'optimal', [160.0, 60.0, 20.0], [], planned, shots, False]
        events.append([time, 'robot', 'blue', [150.0, 60.0, 20.0, 0.0], -1.0, 1, ''])
        events.append([time, 'cuboid', 'blue', *plan])
        words = f'cuboids that it plans to visit: {", ".join(map(str, planned))}'
        if not shots:
            events.append([time, 'log', '', 'decision', 'blue', words])
    events.append([2.0, 'log', '', 'found', 'blue', 'snapshot of cuboid 5'])
    middle = np.mean(part, axis=1)
    box = np.mean(scene['objects'][owner], axis=1)
    with chromium() as shown:
        shown.show(scene, *events)
        # Seen from in front of the face.
        ahead = np.sign(middle - box)[face // 2] * np.eye(3)[face // 2]
        turn = math.atan2(-ahead[0], -ahead[1])
        shown.page.evaluate(f'maasi.camera.turn = {turn}; maasi.camera.update(); maasi.fit()')
        aside = np.mean(scene['cells'][next(i for i in own if i != 5)][2], axis=1)
        for time, share in ((1.0, 0), (2.0, 100 // len(own))):
            shown.seek(time)
            colours = [shown.colour(*shown.place(*item)) for item in (middle, aside)]
            assert (np.abs(np.subtract(colours[0], PHOTOGRAPHED)).max() < 60) == (time == 2.0)
            assert np.abs(np.subtract(colours[1], PHOTOGRAPHED)).max() > 60
            centre = np.array([*box])
            centre[face // 2] = middle[face // 2]
            assert f'photographed ({share} %)' in shown.tip(*centre)
        legend = shown.page.inner_text('#legend')
        assert 'share photographed' in legend and 'potential targets' not in legend
        for words, time in (('6', 1.0), ('5, 6', 0.0)):
            shown.seek(2.0)
            shown.page.click(f'#log li.decision:has-text("visit: {words}") >> nth=0')
            shown.settle()
            assert f' {words} within its horizon' in shown.page.inner_text('#why_body')
            assert shown.page.evaluate('maasi.time') == time
        shown.seek(2.0)
        shown.page.click('#space')
        shown.settle()
        wall = np.array([*box])
        wall[face // 2] = middle[face // 2]
        assert 'parts photographed' in shown.tip(*wall)


@pytest.mark.parametrize('width', [1280, 390])
def test_a_strip_for_each_robot_has_the_scale_of_the_time_line(chromium, width):
    # Moves to 4 s, waits to 6 s, is unavailable to 8 s, and has left.
    statuses = [(0.0, 1), (4.0, 2), (6.0, 5), (8.0, 6)]
    events = [
        [time, 'robot', 'rover', [1.0, 1.0, 0.0, 0.0], 1.0, status, ''] for time, status in statuses
    ]
    events += [[time, 'seen', 'rover', [1.0, 1.0, 0.0], []] for time in (2.0, 5.0)]
    events += [[time, 'robot', 'walker', [2.0, 2.0, 0.0, 0.0], 1.0, 1, ''] for time in (0.0, 10.0)]
    with chromium(width, 800) as shown:
        shown.show(PLANE, *events)
        page = shown.page
        strip = page.locator('#strips canvas').first
        box, line = strip.bounding_box(), page.locator('#time').bounding_box()
        assert (box['x'], box['width']) == (line['x'], line['width'])
        words = strip.get_attribute('aria-label')
        shares = 'moving 40 %, waiting 20 %, unavailable 20 %, left 20 %'
        assert words == f'rover: {shares}, 2 measurements'

        def at(time):
            return 8 + (box['width'] - 16) * time / 10.0

        colours = [shown.colour(at(time), 3, '#strips canvas') for time in (3, 5, 7, 9)]
        assert colours[0] == list(BLUE) and colours[2] == [27, 31, 36]
        # Pale, and only a line.
        assert 60 < shown.pixels('#strips canvas')[3, round(at(5))][3] < 90
        assert colours[3] not in (colours[0], colours[2])
        tick, none = (shown.colour(at(time), 9, '#strips canvas') for time in (2.0, 3.0))
        assert tick != none
        strip.click(position={'x': at(5.0), 'y': 3})
        shown.settle()
        assert page.evaluate('maasi.time') == pytest.approx(5.0, abs=0.1)
        assert page.evaluate('maasi.selected') == 'rover'
        now = page.locator('#strips > i').bounding_box()
        assert now['x'] == pytest.approx(box['x'] + at(5.0), abs=2)
        legend = page.inner_text('#legend')
        assert all(word in legend for word in ('waiting', 'measurement', 'left, silent or ended'))
        assert page.evaluate('document.documentElement.scrollWidth') <= width

"""What the page shows as searched, and where targets may still be: the numbers of the planner."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import Header

from maasi_filter import colours
from maasi_filter.models.detection import BoxDetection
from maasi_filter.models.pose import Pose
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.conversions import exploration_to_ros
from maasi_sim.run.facts import Explored
from maasi_sim.run.missions import load_mission
from maasi_sim.run.view.event_log import shades, shares
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.page_file import FOLDER
from maasi_sim.run.view.recording import facts_for
from maasi_sim.run.view.scene import scene_of
from maasi_sim.scenario.schema import Scenario


def random_search(seed):
    """Return scenario, area and a map of random looks at a random valley with prior and zone."""
    rng = np.random.default_rng(seed)
    size = rng.uniform(60.0, 400.0, 2)
    low = rng.uniform(-200.0, 200.0, 2)

    def box(share, width):
        corner = low + share * size
        x, y = corner
        dx, dy = width * size
        return [[x, y], [x + dx, y], [x + dx, y + dy], [x, y + dy]]

    corners = np.array(box(np.zeros(2), 1.0))
    corners[0] += 0.2 * size
    prior = [{'polygon': box(rng.uniform(0.0, 0.6, 2), 0.35), 'weight': float(rng.uniform(2, 30))}]
    content = load_mission('field').scenario.content()
    content['environment'] = {
        'area': corners.tolist(),
        'keep_outs': [{'polygon': box(rng.uniform(0.2, 0.7, 2), 0.15)}],
        'prior': {'polygons': prior, 'floor': 0.1},
        'expected_targets': float(rng.uniform(1.0, 20.0)),
    }
    start = {'start': [*corners.mean(axis=0), 0.0]}
    content['robots'] = {'rover': content['robots']['rover'] | start}
    scenario = Scenario.model_validate(content)
    area = scenario.world(1).area
    explored = UnexploredMap(area, scenario.filter.exploration_spacing)
    for place in rng.uniform(low, low + size, (40, 2)):
        half = 0.15 * size
        explored.update(BoxDetection(-half, half, 0.7), Pose([*place, 0.0]))
    return scenario, area, explored, rng


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('wire', [False, True])
def test_the_numbers_under_the_pointer_are_those_of_the_planner(chromium, seed, wire):
    scenario, area, explored, rng = random_search(seed)
    events = []
    maker = EventMaker(scene_of('valley', scenario), events.append)
    if wire:
        message = exploration_to_ros(explored, Header(frame_id='map'))
        assert isinstance(message, OccupancyGrid)
        facts = facts_for(maker.scene, waits=False)
        values = [KeyValue(key='explored', value=f'{explored.explored_fraction():.3f}')]
        report = DiagnosticArray(status=[DiagnosticStatus(name='/planner_node', values=values)])
        for topic, item in (('/diagnostics', report), ('/exploration', message)):
            package = type(item).__module__.split('.')[0]
            for fact in facts.of(topic, f'{package}/msg/{type(item).__name__}', item):
                maker.add(fact)
    else:
        maker.add(Explored(0.0, '', *explored.shown(), explored.explored_fraction()))
    (shown_map,) = [event for event in events if event[1] == 'map']
    assert shown_map[-1] == pytest.approx(explored.explored_fraction(), abs=1e-3)
    nodes = explored.nodes()
    number = explored.density.ravel() * scenario.environment.expected_targets / area.volume
    chosen = rng.choice(len(nodes), 60, replace=False)
    with chromium() as shown:
        shown.show(maker.scene, *events)
        # The map is drawn with the next frame.
        shown.until('maasi.map.unexplored.searched !== undefined')
        seen = shown.page.evaluate(
            """(places) => places.map((place) => {
              const [x, y] = maasi.camera.project([...place, 0]);
              return maasi.map.unexplored.pick(maasi.map, x, y);
            })""",
            nodes[chosen].tolist(),
        )
        searched = shown.page.evaluate('maasi.map.unexplored.searched')
    most = number.max()
    for index, cell in zip(chosen, seen):
        e = explored.values.ravel()[index]
        if number[index] == 0.0:
            assert cell is None
            continue
        assert cell['share'] == pytest.approx(e, abs=0.02)
        # Cells on a border are open in part.
        assert cell['left'] <= 1.1 * e * most + 0.03 * most
        if explored._open.ravel()[index] == 1.0:
            assert cell['left'] == pytest.approx(e * number[index], abs=0.04 * most)
    ground = explored._open.ravel() > 0.0
    assert searched == pytest.approx(1.0 - explored.values.ravel()[ground].mean(), abs=0.04)


def test_ground_without_a_look_is_not_searched_however_unlikely_targets_are_there():
    scene = scene_of('field', load_mission('field').scenario)
    events = []
    maker = EventMaker(scene, events.append)
    unseen = UnexploredMap(load_mission('field').scenario.world(1).area)
    maker.add(Explored(0.0, '', *unseen.shown(), unseen.explored_fraction()))
    known = shares(events[0][6])
    assert set(known) == {-1.0, 1.0} and events[0][7] == pytest.approx(0.0, abs=1e-9)


def test_letters_stand_for_shares_to_a_seventieth():
    values = np.array([*np.linspace(0.0, 1.0, 1001), -1.0, np.nan, 1.2])
    read = shares(shades(values))
    assert np.abs(read[:1001] - values[:1001]).max() <= 0.5 / 35 + 1e-9
    assert read[1001:].tolist() == [-1.0, -1.0, 1.0]


def test_keep_outs_have_a_colour_that_no_robot_has():
    def rgb(text):
        return np.array([*bytes.fromhex(text.lstrip('#'))], float)

    script = (FOLDER / 'colours.js').read_text(encoding='utf-8')
    bright = [part for part in script.split("'") if part.startswith('#')]
    robots = [*colours.ROBOTS, *colours.NAMED.values()]
    assert len(bright) == len(robots)
    others = [*robots, *bright, colours.FOUND, colours.POTENTIAL, colours.SEEN, colours.AWAY]
    gaps = [np.abs(rgb(item) - rgb(colours.KEEP_OUT)).sum() for item in others]
    assert min(gaps) > 90

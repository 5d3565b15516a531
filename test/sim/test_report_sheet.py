"""The printed page: one page with what was found and searched, and without the true targets."""

import io
import math
import re
from dataclasses import replace
from datetime import datetime, timezone

import numpy as np
import pypdf
import pytest
from small_field import SMALL_FIELD

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import geodetic
from maasi_filter.models.pose import Pose
from maasi_filter.records import FoundTarget, Label
from maasi_filter.reports import Report
from maasi_filter.unexplored_map import UnexploredMap
from maasi_sim.run import facts
from maasi_sim.run.log import RunEnd, RunLog
from maasi_sim.run.targets.coverage import searched_at_least, sectors
from maasi_sim.run.targets.mission import TargetMission
from maasi_sim.run.targets.report import explored_after
from maasi_sim.run.targets.report_sheet import report_pdf
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.search import search

ORIGIN = {'latitude': 46.0, 'longitude': 23.5, 'altitude': 350.0}
PLACES = [20.0, 20.0], [5.0, 55.0]
BEGAN = datetime(2026, 5, 4, 3, 2, 1, tzinfo=timezone.utc).timestamp()


def scenario_of(**environment):
    given = {'bounds': [[0, 60], [0, 60]], 'expected_targets': 2.0} | environment
    drone = SMALL_FIELD['robots']['drone']
    if len(given['bounds']) == 3:
        grid = {'grid': [4, 4, 2], 'spacing': 15.0, 'corner': [7.0, 7.0, 2.0]}
        drone = {**drone, 'candidates': grid}
    values = {**SMALL_FIELD, 'environment': given, 'robots': {'drone': drone}}
    return scenario_from_values(values, 'field')


@pytest.fixture(scope='module')
def run():
    made = search(scenario_of(origin=ORIGIN), 2)
    made.name, made.end_time = 'field', made.steps * made.scenario.step
    return made


def text_of(log):
    reader = pypdf.PdfReader(io.BytesIO(report_pdf(log, explored_after(log))))
    (page,) = reader.pages
    assert [float(size) for size in page.mediabox[2:]] == pytest.approx([595.4, 841.7], abs=0.5)
    return page.extract_text()


def found_log(scenario, targets):
    """Return a log in which a filter has found targets."""
    log = RunLog(scenario, 1, None, 'hand')
    log.add(facts.Updated(1.0, 4, '', [('drone', 0)], targets))
    return log


def target(number, position, covariance=None, label=None):
    spread = 0.04 * np.eye(len(position)) if covariance is None else covariance
    item = FoundTarget(number, np.array(position, float), spread, 'drone', 1, 1.5 * number)
    return item if label is None else replace(item, label=label)


def measured(log, *places):
    for time, place in enumerate(places):
        empty = np.zeros((0, 3)), None, time
        position = np.array([*place, 1.0])
        log.add(facts.Measured(float(time), 'drone', position, Pose(position), *empty))
    return log


def test_found_targets_have_coordinates_and_times(run):
    text = text_of(run)
    positions = np.array([item.position for item in run.found_targets])
    fixes = geodetic(positions, run.scenario.environment.origin)
    assert len(fixes) > 0
    for item, (latitude, longitude, _) in zip(run.found_targets, fixes):
        assert f'{latitude:.6f}, {longitude:.6f}' in text and f'{item.time:.1f} s' in text
    assert 'seconds since the first step' in text and 'UTC' not in text


def test_times_are_utc_where_the_run_kept_pace_with_the_clock():
    log = found_log(scenario_of(), [target(1, [12.0, 34.5]), target(2, [1.0, 2.0])])
    log.add(facts.RobotAt(0.0, 'drone', (1.0, 1.0, 1.0, 0.0), 0.9))
    log.add(facts.RobotAt(1.0, 'drone', (4.0, 5.0, 1.0, 0.0), 0.25))
    log.add(facts.RobotAt(2.0, 'drone', (4.0, 5.0, 1.0, 0.0), 0.5))
    log.add(facts.RobotAt(9.0, 'drone', (4.0, 5.0, 1.0, 0.0), 0.1))  # after the end
    log.close(RunEnd('time_limit', 3.0, 3.0, (), BEGAN), 3.0)
    text = text_of(log)
    assert 'From 2026-05-04 03:02:01 UTC to 2026-05-04 03:02:04 UTC. Times are UTC' in text
    # Without an origin in metres of the map.
    assert '12.00, 34.50' in text and '03:02:02' in text and '03:02:04' in text
    assert re.search(r'drone\s+50 %\s+25 %\s+5 m', text)


def test_the_page_does_not_depend_on_the_true_targets(run):
    other = RunLog(run.scenario, run.seed, None, run.name)
    for fact in run.facts:
        other.add(fact)
    other.end_time, other.end_reason, other.distance = run.end_time, run.end_reason, run.distance
    assert len(other.truth) == 0 < len(run.truth)
    assert text_of(other) == text_of(run)
    for word in ('true', 'missed', 'false', 'RMSE', 'GOSPA', 'all targets found'):
        assert word not in text_of(run)


@pytest.mark.parametrize('seed', range(8))
def test_any_found_target_gives_one_page(seed):
    """Names that are formulas, control signs, many finds, and covariances that are not."""
    generator = np.random.default_rng(seed)
    signs = [*'$\\^_{}%&<>#a ', '\x00', '\x1b', '\n', '\ufffe', '\u4e2d', '\U0001f681', '\ud800']
    dimension = int(generator.integers(2, 4))
    bounds = [[0, 60], [0, 60], [0, 20]][:dimension]
    made = scenario_of(bounds=bounds, **({'origin': ORIGIN} if seed % 2 else {}))
    items = []
    for number in range(int(generator.integers(0, 80))):
        words = [''.join(generator.choice(signs, generator.integers(0, 40))) for _ in range(2)]
        spread = generator.normal(0.0, 10.0 ** generator.integers(-9, 9), (dimension, dimension))
        spread[0, 0] = generator.choice([np.nan, np.inf, -1.0, 0.0, 1.0])
        place = generator.uniform(-1e3, 1e3, dimension)
        items.append(target(number + 1, place, spread, Label(words[0], 0.5, words[1])))
    log = found_log(made, items)
    log.name = ''.join(generator.choice(signs, 90))
    log.end_reason = ''.join(generator.choice(signs, 30))
    text = text_of(log)
    assert f'Found targets ({len(items)})' in text
    assert ('more: see found_targets.csv' in text) == (len(items) > 27)


def test_ground_is_searched_twice_by_another_pass_only():
    log = RunLog(scenario_of(), 1)
    explored = explored_after(log)
    assert searched_at_least(log, explored) == ([0.0, 0.0], 3600.0)
    detection = log.scenario.robots['drone'].sensor.build('drone', 2).detection
    # The share of a fine grid with half of the largest probability.
    axis = (np.arange(600) + 0.5) / 10.0
    fine = np.stack(np.meshgrid(axis, axis, indexing='ij'), axis=-1).reshape(-1, 2)
    here, there = (Pose(np.array([*place, 1.0])) for place in ((20.0, 20.0), (45.0, 45.0)))
    values = [detection.probability(fine, pose) for pose in (here, there)]
    seen = [value >= 0.5 * max(map(np.max, values)) for value in values]
    # A cell of the page's grid on each side of the border.
    tolerance = 2.0 * 4.0 * math.sqrt(math.pi * seen[0].mean()) / 150.0
    measured(log, (20.0, 20.0), (20.0, 20.0))
    (once, twice), _ = searched_at_least(log, explored)
    assert once == pytest.approx(seen[0].mean(), abs=tolerance) and twice == 0.0
    measured(log, (45.0, 45.0), (20.0, 20.0))
    (once, twice), _ = searched_at_least(log, explored)
    assert once == pytest.approx((seen[0] | seen[1]).mean(), abs=2.0 * tolerance)
    again = (seen[0] & ~seen[1]).mean()
    assert twice == pytest.approx(again, abs=2.0 * tolerance) and twice > 0.0


def test_sectors_share_the_probability_of_success(run):
    explored = explored_after(run)
    parts = sectors(explored)
    assert [part.name for part in parts] == [f'{c}{r}' for r in '123' for c in 'ABC']
    assert sum(part.poa for part in parts) == pytest.approx(1.0)
    assert sum(part.pos for part in parts) == pytest.approx(explored.explored_fraction())
    long = scenario_of(bounds=[[0, 180], [0, 60]])
    assert [part.name for part in sectors(explored_after(RunLog(long, 1)))] == ['A1', 'B1', 'C1']
    # The polygons of an area of several, with the prior of each.
    first, second = ([[x, 0.0], [x + 20.0, 0.0], [x + 20.0, 30.0], [x, 30.0]] for x in (0.0, 40.0))
    area = {'type': 'MultiPolygon', 'coordinates': [[first + first[:1]], [second + second[:1]]]}
    area = {'type': 'Feature', 'geometry': area, 'properties': {'unit': 'm'}}
    prior = {'polygons': [{'polygon': second, 'weight': 3.0}], 'floor': 0.0}
    values = scenario_of().environment.model_dump() | {'area': area, 'prior': prior}
    values.pop('bounds')
    two = UnexploredMap(Area(EnvironmentSettings.model_validate(values)), 1.0)
    assert [part.name for part in sectors(two)] == ['1', '2']
    assert [part.poa for part in sectors(two)] == pytest.approx([0.25, 0.75], abs=0.01)


def test_statements_of_persons_count_in_the_order_of_their_times():
    """A search of others is a measurement; a sighting leaves what was searched before it."""
    log = RunLog(scenario_of(), 1)
    log.end_time = 100.0
    measured(log, (20.0, 20.0))
    own = explored_after(log)
    zone = Report('searched', 0.5, zone='45 45 10', position=[45.0, 45.0], time=50.0)
    near, far = (Report('sighting', 2.0, position=at, radius=4.0, time=60.0) for at in PLACES)
    # Two filters receive the same one; the last is after the end.
    late = replace(zone, zone='30 5 5', time=101.0)
    for team, report in (('', zone), ('a', zone), ('', far), ('', late)):
        log.add(facts.Reported(report.time, team, report))
    explored = explored_after(log)
    expected = own.copy()
    expected.search(zone.shape, 0.5)
    before = expected.explored_fraction()
    assert before > own.explored_fraction() + 0.02
    expected.use(far)
    np.testing.assert_array_equal(explored.values, expected.values)
    # N0 = 2 grows by 2, which nobody has searched; the density has cells of its own.
    assert explored.area.expected_targets == 4.0
    assert explored.explored_fraction() == pytest.approx(0.5 * before, rel=2e-3)
    # A new search of that filter forgets them, but not those of the other one.
    log.add(facts.Reported(70.0, '', None))
    log.add(facts.Reported(70.0, '', near))
    assert [item.kind for item in log.reports()] == ['searched', 'sighting']


def test_a_run_writes_the_page(run):
    made = TargetMission('field', run.scenario).tables(run)
    assert made['report.pdf'].startswith(b'%PDF') and made['report.pdf'] == report_pdf(
        run, explored_after(run)
    )

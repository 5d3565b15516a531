"""Statements of persons change a filter as their equations say, and never break it."""

import json
import math

import numpy as np
import pytest
import shapely
from searches import FLOOR, FLOOR_LENGTHS, PLANE, SIDE, floor_sensor, observe, same

from maasi_filter import (
    AgentMeasurement,
    DetectionSettings,
    FilterSettings,
    NoiseSettings,
    Pose,
    SensorSettings,
    load_filter,
)
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import OriginSettings, geodetic
from maasi_filter.make_filter import make_filter
from maasi_filter.reports import (
    CONFIRMED,
    LOOKALIKE,
    REJECTED,
    Report,
    believed,
    origin_of,
    position_on_map,
    review,
    searched,
    sighting,
    sighting_of,
    zone_on_map,
)
from maasi_filter.unexplored_map import UnexploredMap

PMB = FilterSettings(method='pmb', pmb={'particles': 100})
PHD = FilterSettings(births='measurement', **FLOOR_LENGTHS)
FIELD = {'bounds': [[0.0, 100.0]] * 2, 'expected_targets': 4.0}
CLOSED = {**FIELD, 'keep_outs': [{'centre': [70.0, 70.0], 'radius': 20.0}]}
WEIGHTED = {**FIELD, 'prior': {'polygons': [{'polygon': [[0, 0], [50, 0], [50, 50]], 'weight': 5}]}}
methods = pytest.mark.parametrize('settings', [PMB, PHD], ids=['pmb', 'ic_phd'])


def found_on_the_floor(settings, steps=8):
    """Return a filter that has found some of three targets, and a function that measures again."""
    noise, sensor = np.random.default_rng(5), floor_sensor()
    targets = np.array([[1.0, 1.0], [1.1, 1.25], [0.8, 0.9]])
    search = make_filter(settings, FLOOR, np.random.default_rng(1))
    count = 0

    def measure(number=1):
        nonlocal count
        for _ in range(number):
            pose = Pose(np.array([1.0, 1.05, 0.9]))
            values = observe(noise, sensor, targets, pose)
            search.step([AgentMeasurement('a', pose, sensor, values, None, count)], 1, float(count))
            count += 1

    measure(steps)
    assert len(search.found_targets) >= 2
    return search, measure


def ids(search):
    return [target.id for target in search.found_targets]


def reviewed(search, number, confirmed, reliability=0.95):
    report = review(number, confirmed, reliability, 'Ann', search.reviewable())
    return search.use(report, 1.0)


@pytest.mark.parametrize('seed', range(20))
def test_the_belief_is_that_of_bayes(seed):
    """Three hypotheses: a target, something that looks like one, and nothing."""
    rng = np.random.default_rng(seed)
    r, reliability = rng.uniform(0.01, 0.999), rng.uniform(0.5, 0.999)
    log = math.log(reliability / (1.0 - reliability))
    # Statements: nothing and what looks like a target are confirmed with 1 - q.
    target = r * (1.0 - LOOKALIKE)
    rejected = target * (1.0 - reliability)
    rest = (1.0 - target) * reliability
    assert believed(r, -log) == pytest.approx(rejected / (rejected + rest))
    confirmed = r * reliability / (r * reliability + (1.0 - r) * (1.0 - reliability))
    if log > 0.0:
        assert believed(r, log) == pytest.approx(confirmed)
    assert believed(r, 0.0) == r
    assert 0.0 <= believed(r, -log) <= r <= believed(r, log) <= 1.0


@methods
def test_a_rejected_target_is_withdrawn_and_not_found_again_until_it_is_confirmed(settings):
    search, measure = found_on_the_floor(settings)
    before = {target.id: target for target in search.found_targets}
    number = ids(search)[0]
    reviewed(search, number, False)
    assert number not in ids(search)
    assert number in search.reviewable()
    measure(10)
    # Its detections do not make another target at the same position.
    apart = [
        np.linalg.norm(target.position - before[number].position) for target in search.found_targets
    ]
    assert number not in ids(search)
    assert min(apart) > 0.1
    reviewed(search, number, True)
    assert sorted([*ids(search)]) == sorted({*ids(search), number})
    assert number in ids(search)


@methods
@pytest.mark.parametrize('first', [True, False])
def test_to_confirm_and_reject_equally_is_to_say_nothing(settings, first):
    search, _ = found_on_the_floor(settings)
    before = ids(search)
    for confirmed in (first, not first):
        reviewed(search, before[0], confirmed, 0.9)
    assert ids(search) == before
    assert search.statements(before[0]) == pytest.approx(0.0)


@methods
def test_one_doubtful_rejection_does_not_withdraw_a_target_but_several_do(settings):
    search, _ = found_on_the_floor(settings)
    number = ids(search)[0]
    # Odds 9 : 1 at most, each rejection 6 : 4 against: 9 (4 / 6)^n < 1 from n = 6 on.
    needed = 0
    while number in ids(search):
        reviewed(search, number, False, 0.6)
        needed += 1
    assert 2 <= needed <= 6


@methods
def test_a_saved_filter_continues_with_its_reports(settings, tmp_path):
    search, _ = found_on_the_floor(settings)
    reviewed(search, ids(search)[0], False)
    search.use(sighting([1.5, 0.5], 0.3, 0.5, '', search.area), 2.0)
    zone = searched('2 2 0.3', 0.5, 'dogs', search.environment, search.area)
    search.use(zone, 3.0, 7)
    search.save(tmp_path / 'state')
    loaded = load_filter(tmp_path / 'state')
    same(search, loaded)
    assert loaded.reports == search.reports
    assert [item.id for item in loaded.reports] == [1, 2, 3]
    assert loaded.area.expected_targets == pytest.approx(search.area.expected_targets)
    np.testing.assert_array_equal(loaded.area.cells, search.area.cells)
    assert loaded.exploration.explored_fraction() == pytest.approx(
        search.exploration.explored_fraction()
    )


@pytest.mark.parametrize('environment', [FIELD, CLOSED, WEIGHTED])
@pytest.mark.parametrize('seed', range(6))
def test_a_sighting_adds_its_weight_and_changes_nothing_that_was_searched(environment, seed):
    rng = np.random.default_rng(seed)
    area = Area(EnvironmentSettings(**environment))
    e = UnexploredMap(area)
    e.values[...] = rng.uniform(0.0, 1.0, e.values.shape)

    def intensity(kept):
        return area.expected_targets / area.volume * e.cell_volumes() * kept

    seen, left = intensity(1.0 - e.values), intensity(e.values)
    weight, radius = float(rng.uniform(0.1, 3.0)), float(rng.uniform(0.1, 20.0))
    x, y = rng.uniform(10.0, 45.0, 2)
    report = sighting([x, y], radius, weight, '', area)
    area = area.with_sightings([*area.sightings, sighting_of(report)])
    e.adopt_sightings(area)
    assert (e.values >= 0.0).all() and (e.values <= 1.0).all()
    added = intensity(e.values) - left
    # Cells of the density and of e differ, so their sums agree to the discretisation.
    assert added.sum() == pytest.approx(weight, rel=0.05, abs=0.02)
    np.testing.assert_allclose(intensity(1.0 - e.values), seen, rtol=1e-6, atol=1e-9)
    assert area.expected_targets == pytest.approx(4.0 + weight)
    # Its mean over the area is 1.
    assert area.cells.mean() == pytest.approx(area.volume / 1e4, rel=1e-6)
    # Most of it lies within the radius.
    nodes = e.nodes()
    near = np.hypot(*(nodes - [x, y]).T) <= radius + 2.0 * e.step.max()
    assert added.ravel()[near].sum() > 0.8 * added.sum()


def test_a_sighting_is_inside_the_area_and_keep_outs_can_change_after_it():
    area = Area(EnvironmentSettings(**CLOSED))
    assert (area.cells > 0.0).any()
    search = make_filter(PMB, area, np.random.default_rng(0))
    search.use(sighting([50.0, 60.0], 10.0, 2.0, '', area), 0.0)
    for x, y in ([75.0, 70.0], [70.0, 60.0]):
        assert search.area.density(np.array([[x, y]]))[0] == 0.0
    search.adopt_area(Area(EnvironmentSettings(**FIELD)))
    assert search.area.expected_targets == 6.0
    assert search.area.sightings and search.area is search.exploration.area


@pytest.mark.parametrize('seed', range(10))
def test_e_falls_by_the_share_of_a_cell_that_others_searched(seed):
    rng = np.random.default_rng(seed)
    e = UnexploredMap(Area(EnvironmentSettings(**FIELD)), 2.0)
    zone = shapely.MultiPoint(rng.uniform(-20.0, 120.0, (4, 2))).convex_hull
    probability = float(rng.uniform(0.05, 1.0))
    e.search(zone, probability)
    lost = ((1.0 - e.values) * e.cell_volumes()).sum()
    inside = zone.intersection(shapely.box(0, 0, 100, 100))
    # Samples of 0.4 m along the outline.
    assert lost == pytest.approx(probability * inside.area, abs=0.4 * zone.length + 1.0)
    assert e.values.min() >= 1.0 - probability - 1e-12
    assert e.values.max() <= 1.0


def test_what_others_would_have_found_exists_less_as_after_a_missed_detection():
    search = make_filter(PMB, PLANE, np.random.default_rng(1))
    sensor = SensorSettings(
        detection=DetectionSettings(kind='exponential', size=[40.0, 40.0]),
        noise=NoiseSettings(range=1.0, bearing=0.05),
    ).build('a', 2)
    targets = np.array([[30.0, 50.0], [70.0, 50.0]])
    pose = Pose(np.array([50.0, 50.0, 0.0]))
    values = sensor.measurement.measure(targets, pose)
    search.step([AgentMeasurement('a', pose, sensor, values, None, 0)], 1, 0.0)
    first, second = sorted(search.potential, key=lambda item: item.density.mean[0])
    before, r = second.existence, first.existence
    search.use(searched('30 50 15', 0.8, '', search.environment, search.area), 1.0)
    assert first.existence == pytest.approx(r * 0.2 / (1.0 - 0.8 * r), rel=1e-6)
    assert second.existence == before
    # Only half of a component is in a zone: it moves to the other half.
    mean = second.density.mean[0]
    zone = f'POLYGON (({mean} 0, {SIDE} 0, {SIDE} {SIDE}, {mean} {SIDE}, {mean} 0))'
    search.use(searched(zone, 0.8, '', search.environment, search.area), 1.0)
    assert second.existence < before
    assert second.density.mean[0] < mean


BAD = [
    (lambda area: review(3, True, 0.9, '', [1, 2]), 'id: read 3, allowed are 1, 2'),
    (lambda area: review(3, True, 0.9, '', []), 'id: read 3, allowed are none, as no target'),
    (lambda area: review(1, True, 0.3, '', [1]), 'reliability: read 0.3, allowed are 0.5 to'),
    (lambda area: review(1, True, math.nan, '', [1]), 'reliability: read nan'),
    (lambda area: review(1, True, 1.0, 'a' * 101, [1]), 'reliability: read 1,'),
    (lambda area: review(1, True, 0.9, 'a' * 101, [1]), 'source: read 101 characters'),
    (lambda area: sighting([math.inf, 0.0, 0.0], 1.0, 1.0, '', area), 'position.x: read inf'),
    (
        lambda area: sighting([50.0, 50.0], 0.0, 1.0, '', area),
        'radius: read 0, allowed are numbers',
    ),
    (lambda area: sighting([50.0, 50.0], math.nan, 1.0, '', area), 'radius: read nan'),
    (lambda area: sighting([50.0, 50.0], 1.0, -1.0, '', area), 'weight: read -1, allowed'),
    (lambda area: sighting([50.0, 120.0], 1.0, 1.0, '', area), 'position: read .* 20 m outside'),
    (lambda area: sighting([70.0, 70.0], 1.0, 1.0, '', area), 'position: read .* in a keep-out'),
    (
        lambda area: searched('50 50 9', 0.0, '', area.settings, area),
        'detection_probability: read 0',
    ),
    (lambda area: searched('50 50 9', math.nan, '', area.settings, area), 'detection_probability'),
    (lambda area: searched('50 50 -9', 0.5, '', area.settings, area), 'zone: .*radius: read -9'),
    (lambda area: searched('', 0.5, '', area.settings, area), "zone: .*got ''"),
    (
        lambda area: searched('/etc/passwd', 0.5, '', area.settings, area),
        'zone: .*got .*allowed are',
    ),
    (lambda area: searched('500 50 9', 0.5, '', area.settings, area), 'zone: lies 391 m outside'),
    (lambda area: searched('LINESTRING (0 0, 9 9)', 0.5, '', area.settings, area), 'zone: '),
    (
        lambda area: searched('1,' * 10_001, 0.5, '', area.settings, area),
        'zone: read about 10001 corners',
    ),
]


@pytest.mark.parametrize(('make', 'text'), BAD, ids=[text[:24] for _, text in BAD])
def test_bad_statements_are_refused_by_name(make, text):
    with pytest.raises(ValueError, match=text) as error:
        make(Area(EnvironmentSettings(**CLOSED)))
    assert 'keep_outs' not in str(error.value)
    assert '\n' not in str(error.value)


@methods
@pytest.mark.parametrize('seed', range(6))
def test_random_statements_leave_everything_finite(settings, seed):
    """Whatever persons say, in whatever order: numbers stay finite, and probabilities in [0, 1]."""
    rng = np.random.default_rng(seed)
    search, measure = found_on_the_floor(settings)
    odd = [0.0, -1.0, 0.5, 1.0, 1e-9, 1e9, math.nan, math.inf]
    accepted = 0
    for _ in range(60):
        number = [*rng.choice(odd, 3), *rng.uniform(-0.5, 2.6, 3), *rng.uniform(0.0, 1.0, 2)]
        a, b, c, x, y, z, p, q = map(float, number)
        kind = rng.integers(4)
        try:
            if kind == 0:
                report = review(
                    int(rng.integers(0, 6)),
                    bool(rng.integers(2)),
                    0.5 + 0.5 * p,
                    '',
                    search.reviewable(),
                )
            elif kind == 1:
                place = [x, y] if rng.random() < 0.7 else [a, y]
                report = sighting(
                    place, abs(z) if q < 0.7 else b, p if q < 0.8 else c, '', search.area
                )
            elif kind == 2:
                report = searched(
                    f'{x} {y} {abs(z)}', p if q < 0.8 else a, '', search.environment, search.area
                )
            else:
                ring = ', '.join(f'{u} {v}' for u, v in rng.uniform(-1.0, 3.0, (4, 2)))
                report = searched(f'POLYGON (({ring}))', p, '', search.environment, search.area)
        except ValueError:
            continue
        accepted += 1
        assert isinstance(str(search.use(report, 1.0)), str)
        if rng.random() < 0.3:
            measure()
        e = search.exploration.values
        assert np.isfinite(e).all() and e.min() >= 0.0 and e.max() <= 1.0
        assert np.isfinite(search.weights).all() and (search.weights >= 0.0).all()
        assert math.isfinite(search.expected_number) and search.expected_number >= 0.0
        assert np.isfinite(search.area.cells).all() and (search.area.cells >= 0.0).all()
        assert 0.0 <= search.exploration.explored_fraction() <= 1.0
        for item in getattr(search, 'components', []):
            assert 0.0 <= item.belief <= 1.0
        assert all(cluster.mass >= 0.0 for cluster in search.clusters)
    assert accepted > 10
    assert [item.id for item in search.reports] == list(range(1, accepted + 1))


@pytest.mark.parametrize(
    ('report', 'text'),
    [
        (Report(CONFIRMED, 0.95, 'Ann', 3), 'target 3 confirmed by Ann with reliability 0.95'),
        (Report(REJECTED, 0.9, '', 3), 'target 3 rejected with reliability 0.9'),
        (
            Report('sighting', 0.5, 'Bo', position=[1.0, 2.0], radius=5.0),
            'sighting of Bo at (1, 2) m, radius 5 m, 0.5 expected targets',
        ),
        (
            Report('searched', 0.8, 'dogs', zone='0 0 100'),
            '3.14 ha searched by dogs with a probability of detection of 0.8',
        ),
    ],
)
def test_a_report_is_a_sentence_for_people(report, text):
    assert str(report) == text


@pytest.mark.parametrize('seed', range(20))
def test_geographic_positions_and_zones_are_those_of_the_map(seed):
    """Each text in degrees gives the shape in metres; the origin may be next to 180 degrees."""
    rng = np.random.default_rng(seed)
    origin = OriginSettings(latitude=rng.uniform(-70, 70), longitude=rng.choice([9.5, 179.9999]))
    corners = np.array([[10.0, 10.0], [60.0, 15.0], [45.0, 80.0]]) + rng.uniform(-5, 5, (3, 2))
    degrees = geodetic(corners, origin)[:, 1::-1]
    x, y = degrees[0]
    assert position_on_map(x, y, origin) == pytest.approx(corners[0], abs=1e-3)
    centre, radius = zone_on_map(f'{x} {y} 12', origin).rsplit(' ', 1)
    assert [float(word) for word in centre.split()] == pytest.approx(corners[0], abs=1e-3)
    assert float(radius) == 12.0
    shape = shapely.Polygon(np.unwrap(degrees, period=360.0, axis=0))
    ring = [*shape.exterior.coords]
    environment = EnvironmentSettings(**FIELD, origin=origin)
    for text in (str(shape), json.dumps(ring), shapely.to_geojson(shape)):
        zone = zone_on_map(text, origin)
        # Straight edges in degrees bend by less than this on the map.
        assert shapely.from_wkt(zone).hausdorff_distance(shapely.Polygon(corners)) < 1e-2
        report = searched(zone, 0.5, '', environment, Area(environment))
        assert report.shape.area == pytest.approx(shapely.Polygon(corners).area, rel=1e-3)


@pytest.mark.parametrize(
    ('frame', 'text'),
    [
        ('odom', 'frame_id: read odom, allowed are map [m] and wgs84 [degrees]'),
        ('wgs84', 'frame_id: read wgs84, which needs environment.origin'),
    ],
)
def test_other_frames_are_refused(frame, text):
    environment = EnvironmentSettings(**FIELD)
    with pytest.raises(ValueError) as caught:
        origin_of(frame, 'map', environment)
    assert str(caught.value) == text
    assert origin_of('', 'map', environment) is origin_of('map', 'map', environment) is None


@pytest.mark.parametrize(
    ('zone', 'text'),
    [
        ('500 46 30', 'zone: read longitude 500, latitude 46, allowed are 180 and 90 degrees'),
        ('nan 46 30', "zone: got 'nan 46 30', allowed are"),
        ('9 46 x', "zone: got '9 46 x', allowed are x y radius"),
        ('9 46 -3', 'zone: radius: read -3.0, allowed is greater than 0'),
        ('POLYGON ((9 146, 9.1 146, 9.1 146.1, 9 146))', 'zone: feature 1: read longitude 9'),
        ('[[9, 46], [9.1, 46]]', 'zone: read [[9, 46], [9.1, 46]], allowed are at least 3'),
        ('POLYGON ((9 46, 9.1 46.1, 9.1 46, 9 46.1, 9 46))', 'zone: read POLYGON'),
        ('{"type": "Point", "coordinates": [9, 46]}', 'zone: holds no polygon'),
        ('[[9, 46], ' * 3000, 'zone: read about'),
    ],
)
def test_wrong_zones_in_degrees_are_refused(zone, text):
    with pytest.raises(ValueError) as caught:
        zone_on_map(zone, OriginSettings(latitude=46.0, longitude=9.0))
    assert str(caught.value).startswith(text)


@pytest.mark.parametrize(
    ('zone', 'text'),
    [
        ('POLYGON ((9 46, 9.001 46, 9.001 46.001, 9 46))', 'zone: is 0.001 m long in the map: are'),
        ('[[9, 46], [9.01, 46], [9, 46.05]]', 'zone: is 0.05 m long in the map: are these degrees'),
        ('1 1 x', "zone: got '1 1 x', allowed are x y radius"),
    ],
)
def test_wrong_zones_in_metres_are_refused(zone, text):
    environment = EnvironmentSettings(**FIELD)
    with pytest.raises(ValueError) as caught:
        searched(zone, 0.5, '', environment, Area(environment))
    assert str(caught.value).startswith(text)

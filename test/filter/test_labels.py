"""Classes, scores and identities of detections and found targets."""

import numpy as np
import pytest
from searches import floor_sensor, measured, observe, plane_filter, plane_sensor, play

from maasi_filter import AgentMeasurement, FilterSettings, Pose
from maasi_filter.ic_phd.filter import IcPhdFilter, nearest_detection
from maasi_filter.pmb.labels import MISREAD, LabelTally, associate_by_identity
from maasi_filter.records import Label
from maasi_filter.ros.conversions import label_problem, labels_of
from maasi_msgs.msg import Detection, RangeMeasurement

PAIR = np.array([[50.0, 50.0], [51.0, 50.0]])
NAMES = ('left', 'right')


def pair_scans(number):
    """Return scans of two targets 1 m apart, with an error of 1.5 m, from all around."""
    generator = np.random.default_rng(8)
    sensor = plane_sensor(probability=0.99, range_noise=1.5, bearing=0.04)
    scans = []
    for step in range(number):
        position = PAIR.mean(axis=0) + 20.0 * np.array([np.cos(step), np.sin(step)])
        pose = Pose([*position, 0.0])
        rows, labels = [], []
        for target, name in zip(PAIR, NAMES):
            values = observe(generator, sensor, target[None], pose)
            rows.append(values)
            labels += [Label('ball', 0.8, name)] * len(values)
        scans.append(
            AgentMeasurement('robot', pose, sensor, np.concatenate(rows), None, step, labels=labels)
        )
    return scans


def test_targets_closer_than_the_noise_are_told_apart_by_identity():
    search = play(plane_filter(found_radius=1.0), pair_scans(60))
    found = {target.label.identity: target for target in search.found_targets}
    assert len(search.found_targets) == 2
    assert sorted(found) == ['left', 'right']
    for name, place in zip(NAMES, PAIR):
        offset = found[name].position - place
        assert offset @ np.linalg.solve(found[name].covariance, offset) < 16.0
        assert found[name].label.class_id == 'ball'
        assert found[name].label.score == pytest.approx(1.0)


def test_the_papers_filter_reports_the_label_of_the_nearest_detection():
    generator = np.random.default_rng(3)
    sensor = floor_sensor()
    pose = Pose([1.0, 1.0, 0.0])
    targets = np.array([[1.1, 1.0], [0.9, 1.1]])
    lengths = {'found_radius': 0.03, 'removal_distance': 0.06, 'jitter_deviation': 0.003}
    search = IcPhdFilter(FilterSettings(**lengths), [[-0.3, 2.4]] * 2, np.random.default_rng(1))
    for step in range(40):
        values = sensor.measurement.measure(targets, pose)
        values += 0.3 * generator.multivariate_normal(np.zeros(2), sensor.covariance, 2)
        labels = [Label('cup', 0.9, 'a'), Label('plate', 0.7, 'b')]
        search.step(
            [AgentMeasurement('mambo', pose, sensor, values, None, step, labels=labels)], 1, step
        )
    by_place = {
        int(np.argmin(np.linalg.norm(targets - target.position, axis=1))): target.label
        for target in search.found_targets
    }
    assert by_place == {0: Label('cup', 0.9, 'a'), 1: Label('plate', 0.7, 'b')}


@pytest.mark.parametrize(('limit', 'label'), [(3.0, Label('cup')), (1.0, Label())])
def test_the_nearest_label_within_the_limit_may_be_of_another_robot(limit, label):
    sensor = plane_sensor()
    near = measured(sensor, (0.0, 0.0), [[9.0, 0.0]], robot='a')
    far = measured(sensor, (0.0, 0.0), [[12.0, 0.0]], robot='b')
    far.labels = [Label('cup')]
    robot, found = nearest_detection(np.array([10.0, 0.0]), [near, far], limit)
    assert robot is near and found == label


def test_the_class_is_that_of_the_largest_sum_of_scores():
    tally = LabelTally()
    for name, score, share in (('a', 0.5, 1.0), ('b', 0.0, 0.8), ('b', 0.4, 0.5), ('', 0.0, 1.0)):
        tally.add(Label(name, score), share)
    assert tally.label.class_id == 'b'
    assert tally.label.score == pytest.approx(1.0 / 1.5)


def test_an_identity_belongs_to_one_even_if_a_scan_has_it_twice():
    search = plane_filter()
    scan = measured(plane_sensor(), (50.0, 50.0), [[10.0, 0.0], [20.0, 2.0]])
    scan.labels = [Label(identity='x')] * 2
    search.step([scan], 1, 0.0)
    assert sorted(item.labels.identity for item in search.components) == ['', 'x']


@pytest.mark.parametrize('score', [-0.1, 1.1, float('nan')])
def test_scores_are_refused_that_are_no_probability(score):
    with pytest.raises(ValueError, match='score: '):
        Label('cup', score)


@pytest.mark.parametrize('kind', [Detection, RangeMeasurement])
@pytest.mark.parametrize('score', [-5e-7, 0.0, 0.3, 1.0, 1.0000001])
def test_scores_of_messages_may_miss_their_limits_by_rounding(kind, score):
    message = kind(class_id='cup', score=score)
    assert label_problem(message) is None
    (label,) = labels_of([message])
    assert label.score == pytest.approx(min(max(score, 0.0), 1.0), abs=1e-7)
    assert 'score: read' in label_problem(kind(class_id='cup', score=score + 2.0))


@pytest.mark.parametrize(
    ('identity', 'odds', 'known'),
    [('', [1.0, 2.0, 3.0], False), ('a', [1.0, 0.0, 0.0], True), ('c', [0.0, 0.0, 3.0], False)],
)
def test_a_detection_is_of_the_component_of_its_identity_or_of_one_without(identity, odds, known):
    tallies = [LabelTally('a'), LabelTally('b'), LabelTally()]
    table, other = np.array([[1.0], [2.0], [3.0]]), np.ones(1)
    assert associate_by_identity([Label(identity=identity)], tallies, table, other) == [known]
    assert table.ravel().tolist() == odds
    assert other[0] == (MISREAD if known else 1.0)

"""Results that leave the suite: tables of found targets, data frames, the page of the report."""

import csv
import io
import json
import math
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from small_field import SMALL_FIELD, small_field

from maasi_filter.geometry.geodesy import OriginSettings, geodetic
from maasi_filter.records import FoundTarget, Label
from maasi_sim.run.run_options import Options
from maasi_sim.run.targets.mission import TargetMission
from maasi_sim.run.targets.tables import csv_text, found_geojson, found_rows
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.search import search

ORIGIN = OriginSettings(latitude=46.0, longitude=23.5, altitude=350.0)
COVARIANCE = np.array([[0.04, 0.01, 0.02], [0.01, 0.09, 0.03], [0.02, 0.03, 0.16]])


def rows_of(dimension, origin=None):
    found = [
        FoundTarget(number, place[:dimension], COVARIANCE[:dimension, :dimension], 'drone', 3, 7.5)
        for number, place in enumerate(np.array([[1.0, 2.0, 3.0], [9.0, 9.0, 9.0]]), 1)
    ]
    found[0].label = Label('cup', 0.75, 'tag, 3')
    return found_rows(found, np.array([[1.0, 2.0, 3.5]])[:, :dimension], [(0, 0)], origin)


def test_csv_holds_what_was_found():
    true, false = csv.DictReader(io.StringIO(csv_text(rows_of(3), 3, None)))
    assert [float(true[axis]) for axis in 'xyz'] == [1.0, 2.0, 3.0]
    assert {key: float(true[key]) for key in ('xx', 'xy', 'yy', 'xz', 'yz', 'zz')} == {
        'xx': 0.04, 'xy': 0.01, 'yy': 0.09, 'xz': 0.02, 'yz': 0.03, 'zz': 0.16,
    }  # fmt: skip
    assert (true['target'], float(true['error']), true['identity']) == ('0', 0.5, 'tag, 3')
    assert (false['target'], false['error'], false['agent']) == ('', '', 'drone')
    flat = next(csv.DictReader(io.StringIO(csv_text(rows_of(2), 2, None))))
    assert not {'z', 'zz', 'latitude'} & flat.keys()


def test_places_on_the_earth():
    """A degree of the meridian at the equator is 110.574 km, one of the equator 111.320 km."""
    equator = OriginSettings(latitude=0.0, longitude=10.0)
    assert geodetic(np.array([[0.0, 110.574]]), equator)[0, 0] == pytest.approx(1e-3, rel=1e-5)
    (east,) = geodetic(np.array([[111.320, 0.0, 5.0]]), equator)
    assert east[1] == pytest.approx(10.001, abs=1e-8)
    assert east[[0, 2]] == pytest.approx((0.0, 5.0), abs=2e-3)


def test_geojson_has_longitude_first():
    content = json.loads(found_geojson(rows_of(2, ORIGIN)))
    assert content['type'] == 'FeatureCollection'
    first, second = content['features']
    assert first['geometry']['type'] == 'Point'
    longitude, latitude, altitude = first['geometry']['coordinates']
    assert (longitude, latitude, altitude) == pytest.approx((23.5, 46.0, 350.0), abs=1e-4)
    assert latitude > 46.0 and longitude > 23.5
    assert first['properties']['class_id'] == 'cup' and second['properties']['target'] is None


def field(**origin):
    return small_field({**SMALL_FIELD['environment'], 'origin': origin})


def test_nodes_have_the_origin_and_a_wrong_one_is_refused():
    scenario = field(latitude=46.0, longitude=23.5)
    plans = TargetMission('field', scenario).plan_nodes(Options(), Path('/s.yaml'))
    given = {plan.name: plan.parameters.get('environment.origin.latitude') for plan in plans}
    assert given['filter_node'] == given['planner_node'] == given['driver'] == 46.0
    with pytest.raises(ScenarioError, match=r'^field: environment\.origin\.latitude'):
        field(latitude=146.0, longitude=23.5)


def test_data_frames_of_a_search(monkeypatch):
    result = search(field(latitude=46.0, longitude=23.5, altitude=350.0), 2)
    frame = result.to_dataframe()
    assert len(frame) == len(result.found_targets) > 0
    found = result.found_targets[0]
    assert frame.x[0] == found.position[0] and frame.xy[0] == found.covariance[0, 1]
    assert frame.target.notna().sum() == len(result.truth) - result.missed
    assert frame.error.max() < 5.0 and frame.latitude.between(46.0, 46.001).all()
    progress = result.to_dataframe('progress')
    assert len(progress) == len(result.progress)
    assert progress.true_found.iloc[-1] == len(result.truth) - result.missed
    assert progress.drone_measures.sum() == result.total_measurements
    assert math.isfinite(progress.drone_x.iloc[-1])
    with pytest.raises(ValueError, match="'progress'"):
        result.to_dataframe('decisions')
    monkeypatch.setitem(sys.modules, 'pandas', None)
    with pytest.raises(ImportError, match='pip install pandas'):
        result.to_dataframe()


def test_page_of_the_report_is_that_of_the_schema():
    fields = runpy.run_path(str(Path(__file__).parents[2] / 'docs' / 'site' / 'report_fields.py'))
    page = fields['PAGE'].read_text(encoding='utf-8')
    assert fields['with_fields'](page) == page

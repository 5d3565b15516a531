"""Positions of robots in degrees, and as points of the file of an area."""

import json
import warnings
from copy import deepcopy

import numpy as np
import pytest
import yaml

from maasi_filter.geometry.geodesy import OriginSettings, to_map
from maasi_filter.geometry.polygons import InputWarning
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.scenario.loading import load_scenario

RING = [
    [9.8987, 46.5991],
    [9.9013, 46.5991],
    [9.9013, 46.6009],
    [9.8987, 46.6009],
    [9.8987, 46.5991],
]
ORIGIN = OriginSettings(latitude=46.6, longitude=9.9)
HOME = {'latitude': 46.6002, 'longitude': 9.8995}
DRONE = {'type': 'mavlink_drone', 'endurance': {'per_second': 1e-3}}


def point(role, place, **properties):
    shape = {'type': 'Point', 'coordinates': [*place, 0, 0]}
    return {'type': 'Feature', 'properties': {'role': role, **properties}, 'geometry': shape}


def scenario(folder, robots, *points):
    area = {'type': 'Feature', 'properties': None}
    area['geometry'] = {'type': 'Polygon', 'coordinates': [RING]}
    collection = {'type': 'FeatureCollection', 'features': [area, *points]}
    (folder / 'field.geojson').write_text(json.dumps(collection))
    content = {'version': 1, 'environment': {'area': 'field.geojson'}, 'robots': robots}
    content |= {'targets': {'count': 1}, 'limits': {'time': 60.0}}
    file = folder / 'search.yaml'
    file.write_text(yaml.safe_dump(content))
    return load_scenario(file)


def on_map(longitude, latitude):
    return to_map(np.array([[longitude, latitude]]), ORIGIN)[0]


def test_starts_and_chargers_may_be_latitude_and_longitude(tmp_path):
    drone = deepcopy(DRONE)
    drone |= {'start': {**HOME, 'height': 2.5}}
    drone['endurance']['chargers'] = [{'latitude': 46.5998, 'longitude': 9.9001}, [3.0, 4.0, 0.0]]
    robot = scenario(tmp_path, {'drone': drone}).robots['drone']
    assert robot.start[:2] == pytest.approx(on_map(9.8995, 46.6002), abs=1e-3)
    assert robot.start[2] == 2.5 and robot.endurance.chargers[1] == [3.0, 4.0, 0.0]
    assert robot.endurance.chargers[0][:2] == pytest.approx(on_map(9.9001, 46.5998), abs=1e-3)


def test_points_of_the_area_are_starts_and_chargers(tmp_path):
    points = [
        point('start', [9.8995, 46.6002], name='one'),
        point('start', [9.9005, 46.6004], robot='two', name='base'),
        point('home', [9.9002, 46.6001], name='tent'),
        point('start', [9.9002, 46.6001], name='three'),
        point('charger', [9.9002, 46.6001], robot='on'),
    ]
    robots = {'one': deepcopy(DRONE), 'two': {**deepcopy(DRONE), 'start': [5.0, 6.0, 0.0]}}
    with pytest.warns(InputWarning) as caught:
        made = scenario(tmp_path, robots, *points).robots
    left = [
        str(item.message) for item in caught if 'environment.area: ignoring' in str(item.message)
    ]
    assert [text.partition('role ')[2] for text in left] == [
        'start, as its robot is three; allowed as its robot: one, two',
        'charger, as its robot is on; allowed as its robot: one, two',
    ]
    assert made['one'].start[:2] == pytest.approx(on_map(9.8995, 46.6002), abs=1e-3)
    # What a scenario says itself wins.
    assert made['two'].start == [5.0, 6.0, 0.0]
    for robot in made.values():
        (charger,) = robot.endurance.chargers
        assert charger[:2] == pytest.approx(on_map(9.9002, 46.6001), abs=1e-3)


@pytest.mark.parametrize(
    ('start', 'words'),
    [
        ({'latitude': 146.6, 'longitude': 9.9}, 'start: latitude: read 146.6, allowed is a number'),
        (
            {'latitude': 46.6},
            'start: longitude: read nothing, allowed is a number from -180 to 180',
        ),
        ({**HOME, 'z': 3}, 'start: allowed are latitude, longitude, and height above the map'),
        (
            {'latitude': 46.61, 'longitude': 9.9},
            r'start: read \(0, 1112, 0\) m, latitude 46\.610000, longitude 9\.900000, 1012 m '
            r'outside of the area; ',
        ),
        (
            {'latitude': 9.9, 'longitude': 46.6},
            r'latitude 9\.900000, longitude 46\.600000, 4,739 km outside of the area: .* swapped',
        ),
    ],
)
def test_an_impossible_start_is_reported_in_degrees(tmp_path, start, words):
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        with pytest.raises(ScenarioError, match=words) as caught:
            scenario(tmp_path, {'drone': {**DRONE, 'start': start}})
    assert 'search.yaml:' in str(caught.value)

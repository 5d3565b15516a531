"""A search by a detector of another package, and its results on a map."""

import json
from threading import Thread

import numpy as np
import pytest
from blue_detector import BlueDetector
from pymap3d import geodetic2enu
from scenario_runs import Operator, alongside, of_topic, start

pytestmark = pytest.mark.system

ORIGIN = {'latitude': 46.77, 'longitude': 23.62, 'altitude': 350.0}
TARGETS = [[1.5, 1.8], [1.9, 1.4], [1.3, 1.3]]
SEARCH = {
    'version': 1,
    'environment': {'bounds': [[0.8, 2.4], [0.8, 2.4]], 'origin': ORIGIN},
    'targets': {'positions': TARGETS},
    'robots': {
        'mambo': {
            'type': 'mambo',
            'start': [1.9, 1.9, 1.0],
            'candidates': {'grid': [5, 5], 'spacing': 0.3, 'corner': [1.0, 1.0]},
            'camera': {'detections': {'classes': ['person'], 'point': 'centre'}},
        }
    },
    'filter': {'method': 'pmb'},
    'limits': {'time': 120.0},
}


class Detector(Operator):
    """A detector that works during a run, in its own thread."""

    def __init__(self, domain):
        super().__init__(domain)
        self.detector = BlueDetector(self.node, '/mambo/')
        self.thread = Thread(target=self.executor.spin)
        self.thread.start()

    def close(self):
        self.executor.shutdown()
        self.thread.join()
        super().close()


def test_boxes_of_another_package_lead_to_targets_on_a_map(tmp_path):
    with alongside(Detector) as detector:
        options = ('--seed', 906, *detector.options)
        with start(SEARCH, tmp_path / 'run', *options) as run:
            run.finish()
    assert run.code == 0, run.output
    assert (run.report['true_found'], run.report['false_found']) == (3, 0)
    assert {item['class_id'] for item in run.report['found']} == {'person'}
    # Where a map program has them, from file and topic.
    content = json.loads((run.folder / 'found_targets.geojson').read_text())
    points = [feature['geometry']['coordinates'] for feature in content['features']]
    fixes = of_topic(run, '/found_targets/fixes')[-1]['fixes']
    topic = [[item[name] for name in ('longitude', 'latitude', 'altitude')] for item in fixes]
    for lon, lat, alt in np.concatenate([points, topic]):
        place = geodetic2enu(lat, lon, alt, *ORIGIN.values())
        assert np.linalg.norm(np.array(TARGETS) - place[:2], axis=1).min() < 0.03
    ways = json.loads((run.folder / 'ways.geojson').read_text())['features']
    assert [feature['properties']['kind'] for feature in ways] == ['explored', 'way']
    assert ways[1]['properties']['length'] == pytest.approx(run.report['distance']['mambo'])

"""Tests of ./scripts/judge: on small terrains in SAREnv's format, by it or by a stand-in."""

import json
import sys
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from shapely.errors import GEOSException

from maasi_sim.experiments import judge
from maasi_sim.experiments.judge import BASELINES, BOUND, CENTRE, FREE, assess_terrain, main

SIZE, CELL = 2000.0, 100.0
# On the equator and on the middle meridian of a zone of UTM, where that is at 500 km, 0 km.
PLACE = np.array([3.0, 0.0])
DEGREE = 0.9996 * np.array([111319.49, 110574.3])
# In a corner, of which no turned or mirrored map has its victims.
EAST, WEST = np.array([900.0, -400.0]), np.array([-900.0, 400.0])


INSTALLED = find_spec('sarenv') is not None


@pytest.fixture(autouse=True)
def stand_in(monkeypatch):
    if not INSTALLED:
        monkeypatch.syspath_prepend(str(Path(__file__).parent / 'stand_in'))


def terrain(folder, heat=EAST, victims=EAST):
    """Write a terrain with the heat in one cell of 800 m, and the victims in another."""
    folder.mkdir(parents=True)
    cells = np.arange(-SIZE, SIZE, CELL) + CELL / 2.0
    near_x, near_y = (np.abs(cells - at) < 400.0 for at in heat)
    heatmap = np.outer(near_y, near_x).astype(float)
    np.save(folder / 'heatmap.npy', heatmap / heatmap.sum())
    corners = victims + 400.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    polygon = {'type': 'Polygon', 'coordinates': [(PLACE + corners / DEGREE).tolist()]}
    properties = {'feature_type': 'field', 'area_probability': 1.0}
    facts = {
        'type': 'FeatureCollection',
        'features': [{'type': 'Feature', 'properties': properties, 'geometry': polygon}],
        'center_point': PLACE.tolist(),
        'meter_per_bin': CELL,
        'bounds': [500000.0 - SIZE, -SIZE, 500000.0 + SIZE, SIZE],
        'climate': 'temperate',
        'environment_type': 'flat',
    }
    (folder / 'features.geojson').write_text(json.dumps(facts))
    return folder


def test_routes_are_worth_what_the_heatmap_is(tmp_path):
    found = {}
    for name, victims in (('true', EAST), ('wrong', WEST)):
        folder = terrain(tmp_path / name, victims=victims)
        result = assess_terrain(folder, [12.0], 300, seed=900)
        assert result == assess_terrain(folder, [12.0], 300, seed=900)
        assert (result['class'], result['victims']) == ('flat, temperate', 300)
        found[name] = result['found']['12'] | {'unpromised': result['unpromised']}
    best = max(found['true'][name] for name in BASELINES)
    assert found['true'][FREE] > 85.0 > 60.0 > best
    assert best + 15.0 < found['true'][CENTRE] < found['true'][FREE]
    assert found['true'][BOUND] > 95.0 and found['true']['unpromised'] < 5.0
    assert found['wrong'][FREE] < 5.0 and found['wrong'][BOUND] < 15.0
    assert found['wrong']['unpromised'] > 95.0


def test_worse_routes_find_less_and_longer_ones_are_refused(tmp_path, monkeypatch):
    folder, plan = terrain(tmp_path / 'one'), judge.plan_routes

    def found(change):
        monkeypatch.setattr(judge, 'plan_routes', lambda *given: change(*given))
        return assess_terrain(folder, [8.0], 300, seed=900)

    [whole, half] = (
        found(lambda *given, part=part: [path[: len(path) // part] for path in plan(*given)])
        for part in (1, 2)
    )
    assert 0.0 < half['found']['8'][FREE] < 0.7 * whole['found']['8'][FREE]
    longer = found(lambda *given: plan(*given[:3], 2.0 * given[3]))
    assert longer['refused'] == f'{FREE}, {CENTRE}: routes longer than 8 km'
    monkeypatch.setattr(judge.Terrain, '_found', Mock(side_effect=GEOSException('no union')))
    assert assess_terrain(folder, [8.0], 300, seed=900)['refused'] == 'no union'


def test_each_cell_has_its_share_of_the_heat():
    heat = np.zeros((30, 20))
    heat[25, 3] = 1.0
    middles, prior = judge.disc_cells(heat, (0.0, 0.0, 600.0, 600.0), 50.0)
    assert prior.sum() == pytest.approx(1.0)
    at = np.abs(middles - (105.0, 510.0)).max(axis=1) < 25.0 + 15.0
    assert prior[at].sum() > 0.98 and prior[~at].max() < 0.02
    assert np.hypot(*(middles - 300.0).T).max() < 300.0 + 50.0


def test_command_writes_evaluations_and_why_terrains_were_refused(tmp_path, capsys):
    data, out, document = tmp_path / 'data', tmp_path / 'out', tmp_path / 'judge.md'
    for name in ('1', '2', '10', '11', '12'):
        terrain(data / name, victims=WEST if name == '10' else EAST)
    (data / '2' / 'features.geojson').write_text('version https://git-lfs.github.com/spec/v1\n')
    np.save(data / '11' / 'heatmap.npy', np.ones((40, 30)))
    (data / '12' / 'features.geojson').unlink()
    document.write_text('# Judge\n<!-- judge: begin -->\nold\n<!-- judge: end -->\nrest\n')
    options = ['sarenv', '--data', str(data), '--victims', '100', '--seed', '900']
    written = [*options, '--budget', '10', '100', '--out', str(out), '--document', str(document)]
    assert main(written) == 1
    results = json.loads((out / 'judge.json').read_text())['terrains']
    assert [one['terrain'] for one in results] == ['1', '2', '10', '11', '12']
    assert results[0] == assess_terrain(data / '1', [10.0, 100.0], 100, seed=900)
    reasons = {one['terrain']: one['refused'] for one in results if 'refused' in one}
    assert 'large-file pointer' in reasons['2'] and 'git lfs pull' in reasons['2']
    assert reasons['11'] == 'heatmap.npy: read shape (40, 30), its bounds need (40, 40)'
    assert reasons['12'] == 'features.geojson is missing'
    text = document.read_text()
    assert text.startswith('# Judge\n<!-- judge: begin -->\n') and text.endswith('end -->\nrest\n')
    assert 'old' not in text and text.partition('begin -->\n\n')[2].startswith('2 terrains (2 flat')
    [spiral] = [line for line in text.splitlines() if line.startswith('| Spiral')]
    assert spiral.split('|')[4].strip() == '63.1'
    [lost] = [line for line in text.splitlines() if line.startswith('| 10 ') and 'to ' in line][:1]
    assert lost.split('|')[7].strip() == '100.0'
    assert '\nNot evaluated: 12, features.geojson is missing\n' in text
    assert main([*options, '--terrains', '2', '11']) == 2
    assert main([*options, '--terrains', '1', 'x']) == 2
    assert main([*options[:2], str(tmp_path / 'none')]) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith('error')]
    assert 'large-file pointer' in errors[0] and 'no heatmap.npy in x' in errors[1]
    assert len(errors) == 3 and 'none: no heatmap.npy in any folder there' in errors[2]


def test_what_to_install_is_said(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'sarenv.analytics.evaluator', None)
    assert main(['sarenv', '--data', str(tmp_path)]) == 2
    assert 'SAREnv is not installed' in capsys.readouterr().err

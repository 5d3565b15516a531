"""Tests of ./scripts/judge oplib: on an instance made here, with a solution of our own."""

import json

import numpy as np
import pytest

from maasi_sim.experiments.judge import main
from maasi_sim.experiments.judge_oplib import read_instance

# Nodes on a line, 10 m apart: within 60 m and back to the first one, three of them can be visited.
HEAD = 'NAME : line\nTYPE : OP\nDIMENSION : 5\nCOST_LIMIT : 60\nEDGE_WEIGHT_TYPE : {}\n'
COORDINATES = ''.join(f'{i + 1} {10.0 * i} 0.0\n' for i in range(5))
SCORES = '1 0\n2 1\n3 5\n4 2\n5 9\n'
BEST = 8


def clone(folder, kind='EUC_2D', score=BEST, name='line5-gen1-50'):
    """Write an instance and its solution in OPLib's format."""
    instance = folder / 'instances' / 'gen1' / f'{name}.oplib'
    solution = folder / 'solutions' / 'ea4op' / 'gen1' / f'{name}.sol'
    for path in (instance, solution):
        path.parent.mkdir(parents=True, exist_ok=True)
    sections = f'NODE_COORD_SECTION\n{COORDINATES}NODE_SCORE_SECTION\n{SCORES}'
    instance.write_text(f'{HEAD.format(kind)}{sections}DEPOT_SECTION\n1\n-1\nEOF\n')
    if score is not None:
        solution.write_text(f'NAME : line\nROUTE_NODES : 4\nROUTE_SCORE : {score}\n')
    return instance


def test_scores_are_compared_with_the_solution(tmp_path, capsys):
    clone(tmp_path)
    clone(tmp_path, score=16, name='other5-gen1-50')
    clone(tmp_path, kind='GEO', name='geo5-gen1-50')
    document, out = tmp_path / 'page.md', tmp_path / 'out'
    document.write_text('<!-- oplib: begin -->\nold\n<!-- oplib: end -->\n')
    options = ['oplib', '--data', str(tmp_path), '--out', str(out), '--document', str(document)]
    assert main([*options, '--effort', '1']) == 0
    first, second = json.loads((out / 'judge.json').read_text())['instances']
    assert (first['nodes'], first['generation'], first['ea4op']) == (5, 'gen1', BEST)
    assert first['gaps'] == {'1': pytest.approx(0.0)}
    assert second['gaps'] == {'1': pytest.approx(-50.0)}
    assert first['seconds']['1'] > 0.0
    assert '| gen1 | 5 to 5 | 2 | -25.0 | -50.0 |' in document.read_text()
    assert 'other5-gen1-50 -50.0' in capsys.readouterr().out


def test_what_cannot_be_read_is_refused(tmp_path, capsys):
    clone(tmp_path)
    clone(tmp_path, kind='GEO', name='geo5')
    clone(tmp_path, score=None, name='unsolved5')
    options = ['oplib', '--data', str(tmp_path), '--terrains']
    assert main([*options, 'line5-gen1-50', 'geo5', 'unsolved5']) == 1
    text = capsys.readouterr().out
    assert 'Not evaluated: geo5, EDGE_WEIGHT_TYPE' in text
    assert 'Not evaluated: unsolved5, unsolved5.sol is missing' in text
    assert main([*options, 'nothing']) == 2
    assert main(['oplib', '--data', str(tmp_path / 'none')]) == 2
    path = clone(tmp_path, name='short5')
    path.write_text(path.read_text().replace('5 9\n', ''))
    with pytest.raises(ValueError, match='DIMENSION'):
        read_instance(path)
    nodes, scores, limit = read_instance(clone(tmp_path))
    assert np.array_equal(nodes[:, 0], 10.0 * np.arange(5)) and scores[4] == 9 and limit == 60

"""Settings as flat parameters, and back."""

import math
import re

import pytest

from maasi_drivers.drivers import TurtlebotDriver
from maasi_filter.filter_node import FilterNode
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import (
    flatten,
    node_help,
    parameter_fields,
    unflatten,
    written,
)
from maasi_filter.ros.run_node import run
from maasi_planner.planner_node import PlannerNode
from maasi_sim.run.buildings.cuboid_sim_node import CuboidSimNode

CONTENT = {
    'step': 0.1,
    'seed': 7,
    'environment': {
        'bounds': [[-0.3, 2.4], [0.0, 2.0]],
        'obstacles': [{'centre': [0.8, 1.2], 'radius': 0.1}],
    },
    'filter': {'particles': 500, 'found_radius': 0.02},
    'robots': {
        'b': {'sensor': {'detection': {'kind': 'box', 'lower': [-0.1, -0.1], 'upper': [0.2, 0.2]}}},
        'a': {'sensor': {'noise': {'range': 0.1, 'bearing': 2.0, 'as': 'variance'}}},
    },
}


def test_round_trip():
    settings = FilterNodeSettings.model_validate(CONTENT)
    flat = flatten(settings)
    assert flat['environment.bounds'] == [-0.3, 2.4, 0.0, 2.0]
    assert flat['environment.obstacles'] == ['0.8 1.2 0.1']
    assert flat['robots'] == ['a', 'b']
    assert flat['robot.a.sensor.noise.as'] == 'variance'
    assert 'filter.found_mass' not in flat
    assert FilterNodeSettings.model_validate(unflatten(FilterNodeSettings, flat)) == settings


def test_every_field_is_a_parameter_with_a_description():
    flat = flatten(FilterNodeSettings.model_validate(CONTENT))
    fields = {item.name: item for item in parameter_fields(FilterNodeSettings, flat)}
    assert set(flat) <= set(fields)
    assert all(item.info.description for item in fields.values())
    assert fields['filter.particles'].constraints == 'at least 1 and at most 5000000'
    assert 'paper_003' in fields['filter.preset'].constraints
    assert fields['filter.found_mass'].default is None


@pytest.mark.parametrize(
    ('bounds', 'problem'),
    [([0.0, 2.0, 0.0], '.*0.0, 2.0, 0.0.*of 2'), (['zero one'], ".*'zero one'")],
)
def test_bounds_that_are_none_are_named(bounds, problem):
    flat = flatten(FilterNodeSettings.model_validate(CONTENT))
    flat['environment.bounds'] = bounds
    with pytest.raises(ValueError, match=rf'environment\.bounds: {problem}'):
        unflatten(FilterNodeSettings, flat)


def test_help_of_a_node_names_topics_and_parameters(capsys, monkeypatch):
    monkeypatch.setattr('sys.argv', ['filter_node', '--help'])
    assert run(FilterNode) == 0
    text = capsys.readouterr().out
    assert text.startswith('usage: filter_node')
    assert '`measurement_batch` (maasi_msgs/MeasurementBatch)' in text
    assert 'lockstep/step' in text and 'environment.bounds' in text
    assert 'robot.NAME.sensor.detection.probability' in text
    assert 'allowed: above 0.0 and at most 10.0; default: 0.05' in text
    # What its constructor takes is for who writes code.
    assert 'lockstep_member' not in text


@pytest.mark.parametrize('node', [FilterNode, PlannerNode, TurtlebotDriver, CuboidSimNode])
def test_help_lists_each_section_once_and_nothing_for_programmers(node):
    text = node_help(node, 'node', LockstepLifecycleNode)
    titles = re.findall(r'^(.+)\n-+$', text, re.M)
    assert len(set(titles)) == len(titles) and {'Publishes', 'ROS parameters'} <= set(titles)
    assert not {'Parameters', 'Attributes', 'Notes'} & set(titles)
    assert text.count('/diagnostics` (diagnostic_msgs/DiagnosticArray), each second') == 1
    assert re.search(r'\b00[0-4]\b', text.partition('ROS parameters')[0]) is None


def test_defaults_are_written_without_the_notation_of_python():
    assert written([0.0, math.pi / 2.0, True, 'west']) == '[0.0, 1.5708, true, west]'
    assert [written(value) for value in (10000, 0.25, 1e-6)] == ['10000', '0.25', '1e-06']

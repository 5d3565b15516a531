"""Each planner has its own settings: in scenarios, parameters and code."""

import itertools
from typing import Literal, get_args, get_origin

import pytest
import yaml

from maasi_filter.ros.parameters import flatten, parameter_fields, parameters_of, unflatten
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.objective.settings import InformationSettings, PaperSettings
from maasi_planner.planner_node import PlannerNode
from maasi_planner.settings import PLANNERS, planner_settings, settings_model
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.scenario.loading import find_scenario, load_scenario

NAMES = sorted(PLANNERS.built_in)
MODELS = {name: settings_model({'name': name}) for name in NAMES}
FIELDS = {key: info for model in MODELS.values() for key, info in model.model_fields.items()}


def changed(info):
    """Return another value of a field than its default, where it has one."""
    if get_origin(info.annotation) is Literal:
        return get_args(info.annotation)[-1]
    if isinstance(info.default, bool):
        return not info.default
    return info.default + 1 if isinstance(info.default, int) else 0.5 * (info.default or 3.0)


VALUES = {key: changed(info) for key, info in FIELDS.items() if key not in ('name', 'settings')}
VALUES |= {'name': 'auto', 'settings': None, 'coordination': 'centralized'}


def plain(value):
    """Return a value as YAML has it."""
    return yaml.safe_dump(value).splitlines()[0]


@pytest.mark.parametrize('name', NAMES)
def test_a_scenario_refuses_the_keys_of_other_planners(name, tmp_path):
    content = yaml.safe_load(find_scenario('mambo_turtlebot').read_text())
    values = {key: value for key, value in VALUES.items() if key in MODELS[name].model_fields}
    others = VALUES.keys() - values.keys()
    content['planner'] = VALUES | {'name': name}
    path = tmp_path / 'scenario.yaml'
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    lines = path.read_text().splitlines()
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    refused = str(caught.value).splitlines()
    assert len(refused) == len(others) > 0
    for key in others:
        number = lines.index(f'  {key}: {plain(VALUES[key])}', lines.index('planner:')) + 1
        words = f'{path}:{number}: planner.{key}: unknown key {key!r}'
        (line,) = (line for line in refused if line.startswith(words))
        assert ', known are name, settings, measurement, ' in line
    content['planner'] = values | {'name': name}
    path.write_text(yaml.safe_dump(content))
    scenario = load_scenario(path)
    assert type(scenario.planner) is MODELS[name]
    path.write_text(scenario.text())
    assert load_scenario(path).planner == scenario.planner
    # Another one instead of it has the keys that it knows.
    for other in NAMES:
        changes = {'--planner': (('planner', 'name'), other)}
        changed = load_scenario(path, changes).planner
        assert type(changed) is MODELS[other] and changed.name == other
        assert changed == scenario.planner.renamed(other)


@pytest.mark.parametrize('name', NAMES)
def test_a_node_has_the_parameters_of_its_planner(name):
    given = {
        'environment.bounds': [0.0, 1.0, 0.0, 1.0],
        'robots': ['a'],
        'robot.a.candidates.ring': 4,
        'robot.a.candidates.distance': 1.0,
        'planner.name': name,
    }
    fields = {item.name: item for item in parameter_fields(PlannerNodeSettings, given)}
    keys = {key.removeprefix('planner.') for key in fields if key.startswith('planner.')}
    assert keys == set(MODELS[name].model_fields)
    given |= {f'planner.{key}': VALUES[key] for key in keys - {'name', 'settings'}}
    settings = PlannerNodeSettings.model_validate(unflatten(PlannerNodeSettings, given))
    assert type(settings.planner) is MODELS[name]
    flat = flatten(settings)
    assert {key: flat[key] for key in given if key.startswith('planner.')} == {
        key: value for key, value in given.items() if key.startswith('planner.')
    }
    # What is known of no planner in particular is what the default has.
    none = {item.name for item in parameter_fields(PlannerNodeSettings, {})}
    assert none >= {f'planner.{key}' for key in MODELS['auto'].model_fields}


def test_the_help_of_the_node_has_the_parameters_of_all_planners():
    names = [item.name for item in parameters_of(PlannerNode)]
    assert len(names) == len(set(names))
    assert set(names) >= {f'planner.{key}' for key in VALUES}


def test_the_objective_chooses_the_defaults():
    paper, other = planner_settings(objective='paper'), planner_settings('maasi')
    assert type(paper) is PaperSettings and type(other) is InformationSettings
    assert (paper.beta, paper.control_weight, paper.count_present) == (0.5, 1.0, True)
    assert (other.beta, other.control_weight, other.count_present) == (1.0, 1e-6, False)
    assert planner_settings('asi', objective='paper', beta=0.7).renamed('maasi').beta == 0.7
    with pytest.raises(ValueError, match=r"objective\n.*'paper' or 'information'"):
        planner_settings(objective='papr')
    with pytest.raises(ValueError, match='horizon'):
        planner_settings('maasi', horizon=2)


def test_null_is_the_default(tmp_path):
    content = yaml.safe_load(find_scenario('mambo_turtlebot').read_text())
    content['planner'] = {'name': 'maasi', 'objective': 'paper', 'beta': None}
    path = tmp_path / 'scenario.yaml'
    path.write_text(yaml.safe_dump(content))
    assert load_scenario(path).planner == planner_settings('maasi', objective='paper')


def test_one_planner_after_another_keeps_what_both_have():
    for first, second in itertools.permutations(NAMES, 2):
        keys = MODELS[first].model_fields.keys() - {'name', 'settings', 'objective'}
        made = planner_settings(first, **{key: VALUES[key] for key in keys})
        again = made.renamed(second)
        assert type(again) is MODELS[second] and again.model_fields_set - {'name'} == (
            keys & MODELS[second].model_fields.keys()
        )
        assert all(getattr(again, key) == VALUES[key] for key in again.model_fields_set - {'name'})

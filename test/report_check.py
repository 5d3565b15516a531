"""Checks a report against the schema that is shipped, strictly: no field that it does not know."""

import json
from functools import cache
from importlib.resources import files
from typing import Any

import jsonschema

SCHEMA = files('maasi_sim.run').joinpath('report.schema.json')


def _strict(part: Any) -> Any:
    if isinstance(part, list):
        return [_strict(item) for item in part]
    if not isinstance(part, dict):
        return part
    closed = {key: _strict(item) for key, item in part.items()}
    if 'properties' in closed and 'required' in closed:
        closed['additionalProperties'] = False
    return closed


@cache
def _validators() -> dict[str, jsonschema.Draft202012Validator]:
    whole = json.loads(SCHEMA.read_text(encoding='utf-8'))
    jsonschema.Draft202012Validator.check_schema(whole)
    return {
        kind['properties']['mission']['const']: jsonschema.Draft202012Validator(_strict(kind))
        for kind in whole['oneOf']
    }


def check_report(report: dict[str, Any]) -> dict[str, Any]:
    _validators()[report['mission']].validate(report)
    return report

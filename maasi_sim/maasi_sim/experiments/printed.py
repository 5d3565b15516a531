"""What the papers report and leave open: the YAML files in `published/`, one per paper."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import yaml

from maasi_sim.experiments.cases import Choice, Published

_FOLDER = Path(__file__).with_name('published')


@cache
def _paper(number: str) -> dict[str, Any]:
    text = (_FOLDER / f'paper_{number}.yaml').read_text(encoding='utf-8')
    content: dict[str, Any] = yaml.safe_load(text)
    return content


def printed(name: str) -> dict[str, Any]:
    """Return the fields of the `Experiment` of this name that are text and numbers of the paper.

    These are `published`, `choices` and, where they are given, `causes`, `tested` and `note`.
    """
    paper = _paper(name[:3])
    entry = dict(paper['experiments'][name])
    published = [Published(**row) for row in entry.pop('published', [])]
    choices = [Choice(**paper['choices'][key]) for key in entry.pop('choices')]
    return {'published': published, 'choices': choices, **entry}

"""Runs examples/search.ipynb and stores its outputs in it; needs no Jupyter.

./scripts/python docs/site/notebook.py
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use('Agg')
from matplotlib import pyplot

NOTEBOOK = Path(__file__).resolve().parents[2] / 'examples' / 'search.ipynb'


def outputs_of(source: str, names: dict[str, Any]) -> list[dict[str, Any]]:
    """Run a cell; return what it printed, and its figures."""
    printed, figures = io.StringIO(), []

    def show() -> None:
        for number in pyplot.get_fignums():
            file = io.BytesIO()
            pyplot.figure(number).savefig(file, format='png', dpi=80, bbox_inches='tight')
            figures.append(base64.b64encode(file.getvalue()).decode())
        pyplot.close('all')

    pyplot.show = show
    with contextlib.redirect_stdout(printed):
        exec(source, names)
    outputs: list[dict[str, Any]] = []
    if printed.getvalue():
        text = printed.getvalue().splitlines(keepends=True)
        outputs.append({'name': 'stdout', 'output_type': 'stream', 'text': text})
    for figure in figures:
        data = {'image/png': figure}
        outputs.append({'data': data, 'metadata': {}, 'output_type': 'display_data'})
    return outputs


def main() -> None:
    os.chdir(NOTEBOOK.parent)
    notebook = json.loads(NOTEBOOK.read_text())
    names: dict[str, Any] = {}
    cells = (cell for cell in notebook['cells'] if cell['cell_type'] == 'code')
    for number, cell in enumerate(cells, 1):
        cell['outputs'] = outputs_of(''.join(cell['source']), names)
        cell['execution_count'] = number
    NOTEBOOK.write_text(json.dumps(notebook, indent=1) + '\n')


if __name__ == '__main__':
    main()

"""The module of the console scripts."""

import signal
import sys

import maasi_filter_entry


def test_a_script_runs_its_node(monkeypatch):
    from maasi_filter.filter_node import FilterNode
    from maasi_filter.ros import run_node

    monkeypatch.setattr(signal, 'signal', lambda *_: None)
    monkeypatch.setattr(run_node, 'run', {FilterNode: 7}.get)
    assert maasi_filter_entry.filter_node() == 7


def test_what_an_extra_brings_is_named_where_it_is_missing(monkeypatch, capsys):
    from maasi_filter.ros import run_node

    def run(_):
        raise ModuleNotFoundError("No module named 'matplotlib'", name='matplotlib')

    monkeypatch.setattr(signal, 'signal', lambda *_: None)
    monkeypatch.setattr(run_node, 'run', run)
    monkeypatch.setattr(sys, 'argv', ['/opt/lib/maasi_filter/filter_node'])
    assert maasi_filter_entry.filter_node() == 2
    assert capsys.readouterr().err == (
        'error: filter_node: no module matplotlib: it comes with an extra of the package '
        '(docs/install.md)\n'
    )

"""The module of the console scripts."""

import signal

import pytest

import maasi_entry


def test_a_script_runs_main_of_its_module(monkeypatch):
    from maasi_filter import filter_node

    monkeypatch.setattr(signal, 'signal', lambda *_: None)
    monkeypatch.setattr(filter_node, 'main', lambda: 7)
    assert maasi_entry.maasi_filter.filter_node() == 7


@pytest.mark.parametrize('name', ['generate_test_description', 'pytestmark', '__path__of'])
def test_what_is_no_package_of_ours_is_no_script(name):
    assert not hasattr(maasi_entry, name)

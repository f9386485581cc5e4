"""Tests of `util/variables.py`."""

import pytest

from lare_rl.util.variables import read_variable


def test_value_is_stripped(monkeypatch):
    monkeypatch.setenv("LARE_PLUGINS", " my_plugin\n")
    assert read_variable("LARE_PLUGINS") == "my_plugin"
    monkeypatch.delenv("LARE_PLUGINS")
    assert read_variable("LARE_PLUGINS") == ""


def test_variable_without_a_meaning():
    with pytest.raises(KeyError):
        read_variable("LARE_SECRET")

"""Tests of `util/variables.py`."""

import ast
from pathlib import Path

import pytest

import lare_rl
from lare_rl.util.variables import VARIABLES, read_variable

PACKAGE = Path(lare_rl.__file__).parent


def test_value_is_stripped(monkeypatch):
    monkeypatch.setenv("LARE_PLUGINS", " my_plugin\n")
    assert read_variable("LARE_PLUGINS") == "my_plugin"
    monkeypatch.delenv("LARE_PLUGINS")
    assert read_variable("LARE_PLUGINS") == ""


def test_variable_without_a_meaning():
    with pytest.raises(KeyError):
        read_variable("LARE_SECRET")


def names_of_read_variables(tree):
    """Yield the names that `read_variable("NAME")` and `environment["NAME"]` or `"NAME" in environment` are called with."""
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name(id="read_variable"), args=[ast.Constant(value=name)]):
                yield name
            case ast.Call(
                func=ast.Attribute(value=ast.Name(id="environment"), attr="get"), args=[ast.Constant(value=name), *_]
            ):
                yield name
            case ast.Compare(left=ast.Constant(value=name), comparators=[ast.Name(id="environment")]):
                yield name


def test_the_package_reads_no_other_variable():
    names, direct = set(), []
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names |= set(names_of_read_variables(tree))
        direct += [
            path.name
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute)
            and node.attr in ("get", "getenv")
            and ast.unparse(node) in ("os.environ.get", "os.getenv")
        ]
    assert direct == ["variables.py"]
    assert {"LARE_CACHE", "LARE_PLUGINS", "JAX_COMPILATION_CACHE_DIR"} <= names <= set(VARIABLES)

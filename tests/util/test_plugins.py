import importlib.metadata
import sys

import pytest

from lare_rl.credit.methods import METHODS, find_method
from lare_rl.errors import LareError
from lare_rl.util.plugins import Registry, load_plugins

PLUGIN = """
from lare_rl.credit.methods import Method, register_method
register_method(Method("from-plugin", "a plugin's method", "this test"))
"""


@pytest.fixture
def plugin_directory(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(METHODS, "_values", dict(METHODS._values))
    load_plugins.cache_clear()
    yield tmp_path
    load_plugins.cache_clear()
    sys.modules.pop("my_plugin", None)


def test_registry():
    numbers = Registry[int]("number")
    numbers.register("one", 1)
    numbers.register("one", 1)
    assert (dict(numbers), numbers.find("one"), len(numbers), "two" in numbers) == ({"one": 1}, 1, 1, False)
    with pytest.raises(LareError, match="another number 'one'"):
        numbers.register("one", 2)
    with pytest.raises(LareError, match=r"no number 'ones' .*'one'.*numbers are one"):
        numbers.find("ones")
    with pytest.raises(KeyError):
        numbers["ones"]


def test_plugin_of_the_environment_variable(plugin_directory, monkeypatch):
    (plugin_directory / "my_plugin.py").write_text(PLUGIN)
    monkeypatch.setenv("LARE_PLUGINS", " my_plugin, ")
    assert find_method("rd").name == "rd"
    assert "my_plugin" not in sys.modules
    assert find_method("from-plugin").name == "from-plugin"
    assert "from-plugin" in list(METHODS)


def test_plugin_of_an_installed_package(plugin_directory):
    (plugin_directory / "my_plugin.py").write_text(PLUGIN)
    info = plugin_directory / "my_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[lare_rl.plugins]\nmine = my_plugin\n")
    assert importlib.metadata.entry_points(group="lare_rl.plugins")
    assert "from-plugin" in list(METHODS)


@pytest.mark.parametrize("source", [None, "raise ValueError('two\\nlines')"])
def test_broken_plugin(source, plugin_directory, monkeypatch):
    if source is not None:
        (plugin_directory / "my_plugin.py").write_text(source)
    monkeypatch.setenv("LARE_PLUGINS", "my_plugin")
    with pytest.raises(LareError, match="'my_plugin'") as error:
        find_method("from-plugin")
    assert "\n" not in str(error.value)

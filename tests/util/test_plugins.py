import importlib.metadata
import sys
import types

import pytest

from lare_rl.errors import LareError
from lare_rl.util.plugins import Registry, load_plugins

PLUGIN = "from numbers_of_the_test import NUMBERS\nNUMBERS.register('two', 2)\n"


@pytest.fixture
def numbers():
    registry = Registry[int]("number")
    registry.register("one", 1)
    return registry


@pytest.fixture
def plugin(tmp_path, monkeypatch, numbers):
    """The path of a plugin that registers another number. It is not written yet."""
    module = types.ModuleType("numbers_of_the_test")
    module.NUMBERS = numbers
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.syspath_prepend(tmp_path)
    load_plugins.cache_clear()
    yield tmp_path / "my_plugin.py"
    load_plugins.cache_clear()
    for name in ("my_plugin", "my_second_plugin"):
        sys.modules.pop(name, None)


def test_registry(numbers):
    numbers.register("one", 1)
    assert (dict(numbers), numbers.find("one"), len(numbers), "two" in numbers) == ({"one": 1}, 1, 1, False)
    with pytest.raises(LareError, match=r"another number 'one': .*restart Python"):
        numbers.register("one", 2)
    with pytest.raises(LareError, match=r"no number 'ones' .*'one'.*numbers are one"):
        numbers.find("ones")
    with pytest.raises(KeyError):
        numbers["ones"]


@pytest.mark.parametrize("name", ["a/b", "", "has space"])
def test_name_is_checked(name, numbers):
    with pytest.raises(LareError, match="the name of a number has letters"):
        numbers.register(name, 3)


def test_plugin_of_the_environment_variable(plugin, numbers, monkeypatch):
    plugin.write_text(PLUGIN)
    monkeypatch.setenv("LARE_PLUGINS", " my_plugin, ")
    assert numbers.find("one") == 1
    assert "my_plugin" not in sys.modules
    assert numbers.find("two") == 2
    assert list(numbers) == ["one", "two"]


def install(folder, value="my_plugin", package="my-package"):
    """Install a package with an entry point of this value."""
    info = folder / f"{package.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[lare_rl.plugins]\nmine = {value}\n")


def test_plugins_of_two_packages_with_one_name(plugin, numbers):
    plugin.write_text(PLUGIN)
    plugin.with_name("my_second_plugin.py").write_text(PLUGIN.replace("two", "three"))
    install(plugin.parent)
    install(plugin.parent, "my_second_plugin", "second-package")
    assert set(numbers) == {"one", "two", "three"}


def test_plugin_of_an_installed_package(plugin, numbers):
    plugin.write_text(PLUGIN)
    install(plugin.parent)
    assert importlib.metadata.entry_points(group="lare_rl.plugins")
    assert len(numbers) == 2


@pytest.mark.parametrize("source", [None, "raise ValueError('two\\nlines')"])
def test_broken_plugin(source, plugin, numbers, monkeypatch):
    if source is not None:
        plugin.write_text(source)
    monkeypatch.setenv("LARE_PLUGINS", "my_plugin")
    with pytest.raises(LareError, match="'my_plugin'") as error:
        numbers.find("two")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", ["my_plugin", "no_such_plugin:register", "not a module"])
def test_broken_plugin_of_an_installed_package(value, plugin, numbers):
    plugin.write_text("import no_such_module")
    install(plugin.parent, value)
    words = rf"'mine' of the package my-package \(entry point mine = {value}\).*No module named .*uninstall my-package"
    with pytest.raises(LareError, match=words):
        numbers.find("two")

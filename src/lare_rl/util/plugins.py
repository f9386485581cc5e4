"""Plugins: modules whose import registers methods, decoders, algorithms or environment families.

An installed package names its plugins as entry points:

    [project.entry-points."lare_rl.plugins"]
    my-methods = "my_package.methods"

The environment variable `LARE_PLUGINS` names further modules, separated by commas: `LARE_PLUGINS=my_methods,my_envs`. Plugins are
imported when a name is not registered, or when all registered names are listed.
"""

import re
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Generic, TypeVar

from lare_rl.errors import LareError, find_named
from lare_rl.util.sanitize import one_line
from lare_rl.util.variables import read_variable

__all__ = ["Registry", "load_plugins"]

T = TypeVar("T")

_NAME = re.compile(r"[\w.-]+")
_SHOW_LINE = "lare-rl --debug shows the line."


@cache
def load_plugins() -> None:
    """Import all plugins. Later calls do nothing. Raises `LareError` if a plugin cannot be imported."""
    for entry in entry_points(group="lare_rl.plugins"):
        package = entry.dist.name if entry.dist else "its package"
        plugin = f"{entry.name!r} of the package {package} (entry point {entry.name} = {entry.value})"
        module = re.split(r"[:[]", entry.value)[0].strip()  # MODULE, MODULE:NAME or MODULE [EXTRAS]
        advice = f"Update or uninstall {package}."
        _import_plugin(module, plugin, advice, advice)
    for module in filter(None, map(str.strip, read_variable("LARE_PLUGINS").split(","))):
        advice = "Correct LARE_PLUGINS (names of modules, without .py), or add the module's folder to PYTHONPATH."
        if not all(map(str.isidentifier, module.split("."))):
            raise LareError(f"the plugin {module!r} is no name of a module. {advice}")
        _import_plugin(module, repr(module), advice, _SHOW_LINE)


def _import_plugin(module: str, plugin: str, missing_advice: str, import_advice: str) -> None:
    """Import a plugin, which `plugin` describes in the error.

    `missing_advice` says what to do if there is no such module, and `import_advice` if the module imports what does not exist.
    """
    try:
        import_module(module)
    except Exception as error:  # a plugin's code can raise anything
        reason = one_line(f"{type(error).__name__}: {error}")
        name = error.name if isinstance(error, ModuleNotFoundError) else None
        is_missing = name is not None and f"{module}.".startswith(f"{name}.")
        advice = missing_advice if is_missing else import_advice if isinstance(error, ImportError) else _SHOW_LINE
        raise LareError(f"the plugin {plugin} cannot be imported: {reason}. {advice}") from error


class Registry(Mapping[str, T], Generic[T]):
    """Values by name, which plugins can add to: `METHODS = Registry[Method]("method")`."""

    def __init__(self, kind: str, kinds: str | None = None):
        """Create an empty registry. `kind` is the noun for a value in messages, and `kinds` its plural, by default with an s."""
        self._kind, self._kinds = kind, kinds or f"{kind}s"
        self._values: dict[str, T] = {}

    def register(self, name: str, value: T) -> None:
        """Add a value.

        Raises `LareError` if the name has other characters than letters, digits, `-`, `_` and `.`, or if another value has it:
        compiled programs are cached by name.
        """
        if not _NAME.fullmatch(str(name)):
            raise LareError(f"the name of a {self._kind} has letters, digits, -, _ and . only, unlike {name!r}")
        if self._values.setdefault(name, value) != value:
            raise LareError(
                f"there is another {self._kind} {name!r}: choose another name; if you ran the same cell twice, restart Python; if the "
                "plugin's own file starts the training, start it from another file"
            )

    def find(self, name: str) -> T:
        """Return the value of a name. Raises `LareError` if no value has it: the message lists all names."""
        if name not in self._values:
            load_plugins()
        try:
            return find_named(self._kind, self._kinds, name, self._values)
        except LareError as error:
            hint = "; if a plugin has it, name the plugin's module in LARE_PLUGINS"
            raise LareError(f"{error}{'' if read_variable('LARE_PLUGINS') else hint}") from None

    def __getitem__(self, name: str) -> T:
        if name not in self._values:
            load_plugins()
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        load_plugins()
        return iter(self._values)

    def __len__(self) -> int:
        load_plugins()
        return len(self._values)

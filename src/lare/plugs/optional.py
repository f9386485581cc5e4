"""Libraries that only some users have."""

from lare.errors import LareError


def missing(library: str) -> LareError:
    """What to say where a library that an adapter works with is not installed. The extra has its name."""
    return LareError(f"lare.plugs.{library} needs {library}: pip install 'lare-rl[{library}]'")

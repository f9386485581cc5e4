"""Whether what stands around a program is enough for what it may do. Decided before the program is sent to its process."""

import os
from collections.abc import Sequence

from lare.errors import LareError
from lare.latent.sandbox.jail import LAYERS

NEEDED = tuple(layer for layer in LAYERS if layer != "landlock")
"""The least for every program. Kernels before 5.13 have no Landlock, and seccomp refuses all that it refuses."""

ALWAYS = ("no new rights", "seccomp")
"""Without these nothing runs that the gate has not passed, whatever is accepted."""

ACCEPTED = "LARE_WITHOUT"
"""The environment variable that names the layers, with commas between, that somebody knowingly does without."""


class NotIsolated(LareError):
    """The system refuses a layer that a program needs around it. Nothing of the program has run."""


def check_isolation(layers: Sequence[str], gated: bool) -> None:
    """Raise `NotIsolated` where less is in force than a program needs, and nobody accepts that."""
    lacking = [layer for layer in NEEDED if layer not in layers]
    hopeless = [] if gated else [layer for layer in ALWAYS if layer in lacking]
    if hopeless:
        raise NotIsolated(
            f"this system refuses {listed(hopeless)}, and without it no program runs that the gate has not passed: leave "
            "--no-pre-verification out"
        )
    open_ones = [layer for layer in lacking if layer not in accepted()]
    if open_ones:
        raise NotIsolated(
            f"this system refuses {listed(lacking)} to the process of the latent function; to run it all the same, knowing "
            f"that, set {ACCEPTED}={','.join(name.replace(' ', '-') for name in lacking)} (docs/security.md)"
        )


def accepted() -> set[str]:
    """The layers that somebody does without. Raises `LareError` where there is no such layer."""
    names = {name.strip().replace("-", " ") for name in os.environ.get(ACCEPTED, "").split(",")} - {""}
    unknown = sorted(names - set(LAYERS))
    if unknown:
        raise LareError(f"{ACCEPTED} names {unknown[0]!r}: the layers are {', '.join(LAYERS)}")
    return names


def around(layers: Sequence[str]) -> str:
    """What stands around a program, for a person: every layer in force, and every one that was refused."""
    refused = [layer for layer in LAYERS if layer not in layers]
    said = f"a process of its own ({', '.join(layers) or 'without limits'}"
    return said + (f"; refused: {', '.join(refused)})" if refused else ")")


def listed(layers: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(layers[:-1]), layers[-1])))

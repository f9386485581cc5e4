"""Decides whether a jail is strong enough for a program, before the program is sent to its process."""

import os
from collections.abc import Sequence

from lare.errors import LareError
from lare.latent.sandbox.jail import LAYERS

NEEDED = tuple(layer for layer in LAYERS if layer != "landlock")
"""The layers that every program needs. Landlock is not required: kernels before 5.13 lack it, and seccomp covers it."""

ALWAYS = ("no new rights", "seccomp")
"""A program that has not passed the gate never runs without these layers, even if `LARE_WITHOUT` names them."""

ACCEPTED = "LARE_WITHOUT"
"""The environment variable with the layers, separated by commas, that the user agrees to do without."""


class NotIsolated(LareError):
    """The system refuses a layer that the program needs. No part of the program has run."""


def check_isolation(layers: Sequence[str], gated: bool) -> None:
    """Raise `NotIsolated` if a layer that the program needs is missing, and the user has not accepted that."""
    lacking = [layer for layer in NEEDED if layer not in layers]
    hopeless = [] if gated else [layer for layer in ALWAYS if layer in lacking]
    if hopeless:
        raise NotIsolated(
            f"this system refuses {listed(hopeless)}, which is required for a program that has not passed the gate: remove "
            "--no-pre-verification"
        )
    open_ones = [layer for layer in lacking if layer not in accepted()]
    if open_ones:
        raise NotIsolated(
            f"this system refuses {listed(lacking)} to the process of the latent function; to accept this risk and run it "
            f"anyway, set {ACCEPTED}={','.join(name.replace(' ', '-') for name in lacking)} (docs/security.md)"
        )


def accepted() -> set[str]:
    """The layers that the user agrees to do without. Raises `LareError` if a name is not that of a layer."""
    names = {name.strip().replace("-", " ") for name in os.environ.get(ACCEPTED, "").split(",")} - {""}
    unknown = sorted(names - set(LAYERS))
    if unknown:
        raise LareError(f"{ACCEPTED} names {unknown[0]!r}: the layers are {', '.join(LAYERS)}")
    return names


def around(layers: Sequence[str]) -> str:
    """A description of the jail for users: the layers in force, and the layers that the system refused."""
    refused = [layer for layer in LAYERS if layer not in layers]
    said = f"a process of its own ({', '.join(layers) or 'without limits'}"
    return said + (f"; refused: {', '.join(refused)})" if refused else ")")


def listed(layers: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(layers[:-1]), layers[-1])))

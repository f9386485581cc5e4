"""What a program needs around it, and what happens where a system refuses a layer."""

import numpy as np
import pytest

from lare.errors import LareError
from lare.latent.sandbox import isolation, jail, jailed
from lare.latent.sandbox.isolation import NotIsolated, check_isolation
from lare.latent.sandbox.jailed import JailedProgram
from toys import PHI

REFUSE = {
    "no new rights": "jail.no_new_rights = lambda libc: False",
    "landlock": "jail.landlock = lambda libc: False",
    **{name: f"refused.add(jail.resource.{called})" for name, called in jail.LIMITS.items()},
    "seccomp": "jail.seccomp = lambda libc, kill: False",
}
START = """
import sys; sys.path[:] = {path!r}
from lare.latent.sandbox import jail
refused, lower = set(), jail.resource.setrlimit
def setrlimit(number, limits):
    if number in refused: raise ValueError
    lower(number, limits)
jail.resource.setrlimit = setrlimit
REFUSE
from lare.latent.sandbox.worker import main; main({argument!r})
"""


@pytest.fixture
def refusing(seccomp, monkeypatch):
    """Lets the worker's system refuse a layer; gives what the worker was asked."""
    asked, ask = [], JailedProgram.ask

    def refuse(layer: str) -> list:
        monkeypatch.setattr(jailed, "START", START.replace("REFUSE", REFUSE[layer]))
        monkeypatch.setattr(JailedProgram, "ask", lambda self, request: asked.append(request) or ask(self, request))
        return asked

    return refuse


@pytest.mark.parametrize("layer", isolation.NEEDED)
def test_a_program_does_not_run_where_a_layer_is_refused(refusing, monkeypatch, layer):
    asked, named = refusing(layer), layer.replace(" ", "-")
    with pytest.raises(NotIsolated) as error:
        JailedProgram(PHI, 2, 1)
    assert str(error.value) == (
        f"this system refuses {layer} to the process of the latent function; to accept this risk and run it anyway, "
        f"set LARE_WITHOUT={named} (docs/security.md)"
    )
    assert asked == [None]  # the program was not even sent
    monkeypatch.setenv("LARE_WITHOUT", named)
    program = JailedProgram(PHI, 2, 1)
    assert program.isolation.endswith(f"; refused: {layer})")
    assert program.call(np.zeros((1, 2)), np.zeros((1, 1))).error is None
    program.close()


@pytest.mark.parametrize("layer", isolation.ALWAYS)
def test_without_the_gate_nothing_makes_up_for_these(refusing, monkeypatch, layer):
    asked = refusing(layer)
    monkeypatch.setenv("LARE_WITHOUT", layer)
    with pytest.raises(NotIsolated) as error:
        JailedProgram(PHI, 2, 1, gated=False)
    assert str(error.value) == (
        f"this system refuses {layer}, which is required for a program that has not passed the gate: remove "
        "--no-pre-verification"
    )
    assert asked == [None]


def test_an_old_kernel_has_no_landlock_and_that_is_said(refusing):
    refusing("landlock")
    program = JailedProgram(PHI, 2, 1)
    assert program.isolation == (
        "a process of its own (no new rights, memory, file size, core dumps, open files, processes, seccomp; "
        "refused: landlock)"
    )
    program.close()


def test_every_layer_is_refused_here_in_turn():
    assert {*REFUSE} == {*jail.LAYERS} == {*isolation.NEEDED, "landlock"}


@pytest.mark.parametrize(
    ("accepted", "message"),
    [
        ("memory", "this system refuses memory and seccomp to the process of the latent function; to accept this risk and "
         "run it anyway, set LARE_WITHOUT=memory,seccomp (docs/security.md)"),
        ("everything", "LARE_WITHOUT names 'everything': the layers are no new rights, landlock, memory, file size, "
         "core dumps, open files, processes, seccomp"),
    ],
)  # fmt: skip
def test_what_is_accepted_is_named_layer_by_layer(monkeypatch, accepted, message):
    monkeypatch.setenv("LARE_WITHOUT", accepted)
    with pytest.raises(LareError) as error:
        check_isolation([name for name in jail.LAYERS if name not in ("memory", "seccomp")], gated=True)
    assert str(error.value) == message


def test_what_nobody_accepts_is_not_accepted(monkeypatch):
    monkeypatch.delenv("LARE_WITHOUT", raising=False)
    check_isolation(jail.LAYERS, gated=True)
    check_isolation(jail.LAYERS, gated=False)
    with pytest.raises(NotIsolated):
        check_isolation([], gated=True)

"""Reading ends, whatever the text is: limits are checked before time or memory is spent."""

import threading

import pytest

from helpers.attacks import ATTACKS
from helpers.toy_envs import phi_source
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.read import parse, read


@pytest.mark.parametrize("name", ATTACKS)
def test_attack_is_refused(name):
    with pytest.raises(RefusedError) as refusal:
        read(ATTACKS[name], 17, 6)
    assert refusal.value.code not in ("E-BUG", "E-FORM")  # E-FORM: it ran to its end


def test_parser_survives_in_a_thread_with_a_small_stack():
    refusals = []

    def attack():
        for name in list(ATTACKS)[:16]:
            try:
                parse(ATTACKS[name])
            except RefusedError as refusal:
                refusals.append(refusal)

    before = threading.stack_size(256 << 10)
    try:
        thread = threading.Thread(target=attack)
        thread.start()
        thread.join()
    finally:
        threading.stack_size(before)
    assert threading.stack_size() == before
    assert len(refusals) > 8


def test_refusal_cannot_be_caught():
    source = phi_source(
        "try:\n    x = observation.mean(axis=0)\nexcept Exception:\n    x = 0\nfinally:\n    return [action[:, :1]]"
    )
    with pytest.raises(RefusedError, match="E-ROWS"):
        read(source, 17, 6)

"""The artifact: its source, its factors, and its workers."""

import gc
import hashlib
import pickle
from dataclasses import replace

import numpy as np
import pytest

from lare.errors import LareError
from lare.latent.evaluator import LatentRewardError
from lare.latent.function import normal, verified
from lare.latent.verification.checks import CHECKS, Check
from toys import PHI, phi

SOURCE = PHI.strip("\n")
NAMES = ("gate", *CHECKS)


def batch(rows: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((rows, 2), np.float32), np.ones((rows, 1), np.float32)


def test_verified(sound):
    assert (sound.task, sound.kind, sound.source, sound.size) == ("Chase", "factors", SOURCE, 2)
    assert (sound.model, sound.exchanges) == ("none: written by hand", ())
    assert sound.checks == tuple(Check(name, True, "") for name in NAMES)


def test_blank_lines_around_a_source_do_not_count(chase, sound, trusting):
    assert verified(f"\n{PHI}\n", chase) == sound


def test_what_does_not_pass_is_no_function(chase):
    with pytest.raises(LareError) as error:
        verified(phi("x = [][0]\nreturn [x]"), chase)
    assert str(error.value) == (
        "the function does not fit task 'Chase': E-RUN line 2: IndexError: list index out of range"
    )


def test_the_factors_of_a_batch(function):
    observation, action = np.array([[1, 9], [0.5, 9]], np.float32), np.array([[3], [-0.5]], np.float32)
    factors = function(observation, action)
    assert factors.dtype == np.float32
    np.testing.assert_array_equal(factors, [[-4, -9], [-1, -0.25]])


def test_a_function_that_fails_while_it_is_used(chase):
    # It passes on the 256 recorded steps and on everything that was made up of them.
    observation, action = batch(5)
    observation[4, 0] = -6000
    function = verified(phi("near = np.sqrt(observation[:, 0:1] + 5000)\nreturn [action, near]"), chase)
    with pytest.raises(LatentRewardError) as error:
        function(observation, action)
    function.close()
    assert str(error.value) == "the latent function failed: factor 'near' is nan for the observation [-6000.     0.]"
    assert error.value.observation is observation


def test_what_it_would_do_with_seven_rows_nobody_meets(chase):
    # Verification tries no batch of seven, and training has none.
    function = verified(phi("return [action] * (2 if len(action) == 7 else 1)"), chase)
    np.testing.assert_array_equal(function(*batch(7)), batch(7)[1])
    function.close()


def test_names_and_meanings_are_read_off_the_source(function):
    assert function.names == ["f_near", "f_effort"]
    assert function.meanings == ["how near the action comes", "effort"]
    other = replace(
        function, source=phi("# Factor 1: energy,\n# squared\nenergy = action**2\nreturn [-energy, energy]")
    )
    assert other.names == ["factor_1", "energy"]
    assert other.meanings == ["", "energy, squared"]


def test_a_worker_is_started_when_it_is_needed_and_once(function):
    assert function.evaluators == {}
    function(*batch(2))
    worker = function.evaluator(2, 1)
    function(*batch(3))
    assert function.evaluators == {(2, 1): worker}
    function.close()
    assert worker.program.process.returncode is not None
    # It starts again when it is needed.
    np.testing.assert_array_equal(function(*batch(2)), [[-1, -1]] * 2)
    function.close()


def test_the_workers_end_with_the_function(sound):
    function = replace(sound)
    process = function.evaluator(2, 1).program.process
    assert process.poll() is None
    del function
    gc.collect()
    assert process.returncode is not None


def test_a_function_goes_to_another_process_without_its_workers(function):
    function(*batch(2))
    other = pickle.loads(pickle.dumps(function))
    assert other == function
    assert other.evaluators == {}
    function.close()


def test_the_digest_is_the_sources(function):
    assert function.digest == hashlib.sha256(SOURCE.encode()).hexdigest()
    assert replace(function, source=SOURCE + " ").digest != function.digest
    assert replace(function, model="Another").digest == function.digest


def test_null(chase):
    with pytest.raises(LareError, match=r"E-SYNTAX line 2: there is '\\x00', a character that nobody sees"):
        verified(phi("return [action]") + "\0", chase)


def test_headers_beneath_headers_cost_no_time():
    """In a square of them a function file would take minutes."""
    assert normal("# lare: \n\n" * 60_000 + "\nx\n\n") == "x"


def test_a_warning_sign_in_a_comment_is_welcome(chase):
    function = verified(phi("# \u26a0\ufe0f mind the sign\nreturn [-action]"), chase)
    assert "# \u26a0 mind" in function.source
    assert "\ufe0f" not in function.source

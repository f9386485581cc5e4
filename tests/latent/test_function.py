"""The artifact: its source, its graph and its factors."""

import hashlib
import pickle
from dataclasses import replace

import numpy as np
import pytest

from helpers.toys import PHI, phi
from lare_rl.errors import LareError
from lare_rl.latent.factors import LatentRewardError
from lare_rl.latent.function import entries_text, normal, verified
from lare_rl.latent.verify import Check
from lare_rl.phi.graph import Refused

SOURCE = PHI.strip("\n")


def batch(rows: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((rows, 2), np.float32), np.ones((rows, 1), np.float32)


def test_verified(sound):
    assert (sound.task, sound.kind, sound.source, sound.size) == ("Chase", "factors", SOURCE, 2)
    assert sound.sizes == (2, 1)
    assert (sound.model, sound.exchanges) == ("none: written by hand", ())
    assert sound.checks == (Check("read", True, ""), Check("finite", True, ""))


def test_blank_lines_around_a_source_do_not_count(chase, sound, trusting):
    assert verified(f"\n{PHI}\n", chase) == sound


def test_what_does_not_pass_is_no_function(chase):
    with pytest.raises(
        LareError, match=r"^the function does not fit task 'Chase': E-RUN line 2: IndexError: list index out of range"
    ):
        verified(phi("x = [][0]\nreturn [x]"), chase)


def test_the_factors_of_a_batch(function):
    observation, action = np.array([[1, 9], [0.5, 9]], np.float32), np.array([[3], [-0.5]], np.float32)
    factors = function(observation, action)
    assert factors.dtype == np.float32
    np.testing.assert_array_equal(factors, [[-4, -9], [-1, -0.25]])
    np.testing.assert_array_equal(function(observation[0], action[0]), factors[0])


@pytest.mark.parametrize(
    ("observation", "action", "message"),
    [
        (np.zeros((3, 3)), np.zeros((3, 1)), r"observations must have the shape \(batch, 2\).* \(3, 3\)"),
        (np.zeros((3, 2)), np.zeros(3), r"actions must have the shape \(batch, 1\).* \(3,\)"),
        (np.zeros((3, 2)), np.zeros((4, 1)), "there are 3 observations and 4 actions"),
        (np.zeros((3, 2)), [["a"]] * 3, "actions must be arrays of numbers"),
    ],
)
def test_arrays_of_other_sizes_are_refused(function, observation, action, message):
    with pytest.raises(LareError, match=message):
        function(observation, action)


def test_a_function_that_fails_while_it_is_used(chase):
    # It passes on the 256 recorded steps and on everything that was made up of them.
    observation, action = batch(5)
    observation[4, 0] = -6000
    function = verified(phi("near = np.sqrt(observation[:, 0:1] + 5000)\nreturn [action, near]"), chase)
    with pytest.raises(LatentRewardError) as error:
        function(observation, action)
    assert str(error.value) == "the latent function failed: factor 'near' is nan for the observation [-6000.     0.]"
    assert error.value.observation is observation
    assert error.value.action is action


def test_names_and_meanings_are_read_off_the_source(function):
    assert function.names == ["f_near", "f_effort"]
    assert function.meanings == ["how near the action comes", "effort"]
    other = replace(
        function, source=phi("# Factor 1: energy,\n# squared\nenergy = action**2\nreturn [-energy, energy]")
    )
    assert other.names == ["factor_1", "energy"]
    assert other.meanings == ["", "energy, squared"]


def test_entries_that_each_factor_reads(function):
    assert function.entries_read == [
        {"observation": [0], "action": [0]},
        {"observation": [], "action": [0]},
    ]
    assert function.reads == ["observation[0], action[0]", "action[0]"]


@pytest.mark.parametrize(
    ("observation", "action", "text"),
    [
        ([], [], "nothing"),
        ([3], [], "observation[3]"),
        ([8, 9, 13], [0, 1, 2, 3, 4, 5], "observation[8:10, 13], action[0:6]"),
    ],
)
def test_entries_as_text(observation, action, text):
    assert entries_text({"observation": observation, "action": action}) == text


def test_a_source_that_cannot_be_read_has_no_graph(function):
    with pytest.raises(Refused, match="E-FORM"):
        _ = replace(function, source="x = 1").graph


def test_a_function_in_another_process_is_the_same(function):
    other = pickle.loads(pickle.dumps(function))
    assert other == function
    assert "graph" not in other.__dict__
    np.testing.assert_array_equal(other(*batch(2)), function(*batch(2)))


def test_the_digest_is_the_sources(function):
    assert function.digest == hashlib.sha256(SOURCE.encode()).hexdigest()
    assert replace(function, source=SOURCE + " ").digest != function.digest
    assert replace(function, model="Another").digest == function.digest


def test_null(chase):
    with pytest.raises(LareError, match=r"E-SYNTAX line 2: '\\x00' is a character that no reader sees"):
        verified(phi("return [action]") + "\0", chase)


def test_headers_beneath_headers_cost_no_time():
    """In a square of them a function file would take minutes."""
    assert normal("# lare: \n\n" * 60_000 + "\nx\n\n") == "x"


def test_a_warning_sign_in_a_comment_is_welcome(chase):
    function = verified(phi("# \u26a0\ufe0f mind the sign\nreturn [-action]"), chase)
    assert "# \u26a0 mind" in function.source
    assert "\ufe0f" not in function.source

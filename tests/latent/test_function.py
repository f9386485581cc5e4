"""The artifact: saved and loaded, verified again, and strict while a run is under way."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest

from lare.errors import LareError
from lare.latent.function import HEADER, LatentFunction, LatentRewardError, load, verified
from lare.latent.worker import Check
from toys import PHI

SOURCE = PHI.strip("\n")


def phi(body: str) -> str:
    return f"def evaluation_func(observation, action):\n    {body}"


def batch(rows: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((rows, 2), np.float32), np.ones((rows, 1), np.float32)


@pytest.fixture
def function(chase) -> LatentFunction:
    exchanges = ({"stage": "candidate", "messages": [{"role": "user", "content": "Bitte ä"}], "replies": ["{}"]},)
    return replace(verified(SOURCE, chase), model="Somebody, draw 0", exchanges=exchanges)


def test_verified(chase):
    function = verified(SOURCE, chase)
    assert (function.task, function.kind, function.source, function.size) == ("Chase", "factors", SOURCE, 2)
    assert (function.model, function.exchanges) == ("none: written by hand", ())
    names = "runs", "form", "finite", "deterministic", "rows alone"
    assert function.checks == tuple(Check(name, True, "") for name in names)


def test_blank_lines_around_a_source_do_not_count(chase):
    assert verified(f"\n{PHI}\n", chase) == verified(SOURCE, chase)


def test_what_does_not_pass_is_no_function(chase):
    with pytest.raises(LareError) as error:
        verified(phi("return [undefined]"), chase)
    assert str(error.value) == (
        "the function does not fit task 'Chase': runs: NameError: name 'undefined' is not defined (line 2)"
    )


def test_the_factors_of_a_batch(function):
    observation, action = np.array([[1, 9], [0.5, 9]], np.float32), np.array([[3], [-0.5]], np.float32)
    factors = function(observation, action)
    assert factors.dtype == np.float32
    np.testing.assert_array_equal(factors, [[-4, -9], [-1, -0.25]])


def test_whatever_type_the_factors_have_they_become_float32(chase):
    function = verified(phi("return [action > 0, action.astype(np.int8), action * 0.5]"), chase)
    factors = function(*batch(2))
    assert factors.dtype == np.float32
    np.testing.assert_array_equal(factors, [[1, 1, 0.5]] * 2)


# Each passes on the 256 recorded steps and on single ones, and fails on a batch of 7 or outside of the toy's range.
@pytest.mark.parametrize(
    ("body", "message"),
    [
        (
            "if len(action) == 7: raise ValueError('seven')\n    return [action]",
            "the latent function failed: ValueError: seven",
        ),
        (
            "return [action[:3]] if len(action) == 7 else [action]",
            "the latent function gave factors of shape (3, 1), not (7, 1)",
        ),
        (
            "return [action] * (2 if len(action) == 7 else 1)",
            "the latent function gave factors of shape (7, 2), not (7, 1)",
        ),
        (
            "near = np.sqrt(observation[:, 0:1] + 1)\n    return [action, near]",
            "factor 'near' is nan for the observation [-2.  0.]",
        ),
        ("return [1e30 ** (observation[:, 0:1] ** 2)]", "factor 'factor_1' is inf for the observation [-2.  0.]"),
    ],
)
def test_a_function_that_fails_while_it_is_used(chase, body, message):
    observation, action = batch(7)
    observation[4, 0] = -2
    function = verified(phi(body), chase)
    with pytest.raises(LatentRewardError) as error:
        function(observation, action)
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("source", "names", "meanings"),
    [
        (SOURCE, ["f_near", "f_effort"], ["how near the action comes", "effort"]),
        (phi("return [-action, action]"), ["factor_1", "action"], ["", ""]),
        (phi("factors = [action, -action]\n    return factors"), ["factor_1", "factor_2"], ["", ""]),
        (phi("return [action] * 2"), ["factor_1", "factor_2"], ["", ""]),
        (
            phi(
                "# Factor 1: energy,\n    # squared\n    energy = action**2\n\n    rest = -energy\n    return (rest, energy)"
            ),
            ["rest", "energy"],
            ["", "energy, squared"],
        ),
    ],
)
def test_names_and_meanings_are_read_off_the_source(chase, source, names, meanings):
    function = verified(source, chase)
    assert function.names == names
    assert function.meanings == meanings


def test_the_digest_is_the_sources(function):
    assert function.digest == hashlib.sha256(SOURCE.encode()).hexdigest()
    assert replace(function, source=SOURCE + " ").digest != function.digest
    assert replace(function, model="Another").digest == function.digest


@pytest.mark.parametrize("ending", [".py", ".json"])
def test_saved_and_loaded_it_is_the_same(function, chase, tmp_path, ending):
    function.save(tmp_path / "phi.py")
    loaded = load((tmp_path / "phi").with_suffix(ending), chase)
    assert loaded == function
    np.testing.assert_array_equal(loaded(*batch(3)), function(*batch(3)))


def test_the_file_is_python_with_its_provenance_on_top(function, tmp_path):
    function.save(tmp_path / "phi")
    assert (tmp_path / "phi.py").read_text() == (
        "# lare: task: Chase\n"
        "# lare: kind: factors\n"
        "# lare: model: Somebody, draw 0\n"
        f"# lare: sha256: {function.digest}\n"
        "# lare: passed: runs, form, finite, deterministic, rows alone\n"
        f"{SOURCE}\n"
    )
    assert json.loads((tmp_path / "phi.json").read_text())["exchanges"] == list(function.exchanges)


def test_headers_do_not_pile_up(function, chase, tmp_path):
    function.save(tmp_path / "phi.py")
    once = (tmp_path / "phi.py").read_text()
    load(tmp_path / "phi.py", chase).save(tmp_path / "phi.py")
    assert (tmp_path / "phi.py").read_text() == once
    assert once.count(HEADER) == 5


def test_a_function_of_ones_own_needs_no_record(chase, tmp_path):
    (tmp_path / "mine.py").write_text(PHI)
    assert load(tmp_path / "mine.py", chase) == verified(SOURCE, chase)


def test_loading_verifies_again(function, chase, tmp_path):
    path = tmp_path / "phi.py"
    function.save(path)
    path.write_text(path.read_text().replace("[f_near, f_effort]", "[f_near, effort]"))
    with pytest.raises(LareError, match=r"name 'effort' is not defined") as error:
        load(path, chase)
    assert str(error.value).startswith(f"{path}: the function does not fit task 'Chase': runs: NameError: ")


def test_a_change_by_hand_is_noted(function, chase, tmp_path):
    path = tmp_path / "phi.py"
    function.save(path)
    path.write_text(path.read_text().replace("# 2. effort", "# 2. exertion"))
    loaded = load(path, chase)
    assert loaded.model == "Somebody, draw 0; changed by hand since"
    assert loaded.exchanges == function.exchanges
    assert loaded.meanings[1] == "exertion"


@pytest.mark.parametrize("name", ["missing.py", "missing.json", ""])
def test_a_missing_file_is_refused(chase, tmp_path, name):
    path = tmp_path / name
    with pytest.raises(LareError) as error:
        load(path, chase)
    assert str(error.value) == f"there is no function file {path.with_suffix('.py') if name else path}"


def test_a_file_that_is_no_text_is_refused(chase, tmp_path):
    path = tmp_path / "phi.py"
    path.write_bytes(b"\xff")
    with pytest.raises(LareError) as error:
        load(path, chase)
    assert (
        str(error.value)
        == f"{path} cannot be read: 'utf-8' codec can't decode byte 0xff in position 0: invalid start byte"
    )


@pytest.mark.parametrize(
    ("record", "problem"),
    [
        ("{", "JSONDecodeError('Expecting property name enclosed in double quotes: line 1 column 2 (char 1)')"),
        ("{}", "KeyError('source')"),
        ("[]", "TypeError('list indices must be integers or slices, not str')"),
        ('{"source": "", "model": "m", "exchanges": 3}', "TypeError(\"'int' object is not iterable\")"),
    ],
)
def test_a_broken_record_is_refused(function, chase, tmp_path, record, problem):
    function.save(tmp_path / "phi.py")
    (tmp_path / "phi.json").write_text(record)
    with pytest.raises(LareError) as error:
        load(tmp_path / "phi.py", chase)
    assert str(error.value) == f"{tmp_path / 'phi.json'} is not the record of a latent function: {problem}"


@pytest.mark.parametrize(
    "source", [PHI, "\n" + PHI, PHI.replace("\n", "\r\n"), PHI.replace("effort\n", "effort\x0c\n")]
)
def test_saved_and_loaded_it_is_the_same_whatever_its_line_ends(chase, tmp_path, source):
    function = verified(source, chase)
    function.save(tmp_path / "phi.py")
    assert load(tmp_path / "phi.py", chase).digest == function.digest


def test_a_reward_stays_a_reward(chase, tmp_path):
    function = verified(phi("return [action]"), chase, "reward")
    function.save(tmp_path / "phi.py")
    assert load(tmp_path / "phi.py", chase) == function


def test_a_function_that_writes_into_its_input_spoils_nothing(chase):
    function = verified(phi("observation[:] = 0; action *= 0; return [action]"), chase)
    observation, action = np.ones((3, 2), np.float32), np.ones((3, 1), np.float32)
    function(observation, action)
    assert observation.all()
    assert action.all()


def test_null(chase):
    with pytest.raises(LareError, match="null bytes"):
        verified(phi("return [action]") + "\0", chase)


def test_save_nowhere(chase, tmp_path):
    with pytest.raises(LareError, match="cannot be written"):
        verified(PHI, chase).save(tmp_path / "none" / "phi.py")

"""Function files: saved, loaded, changed by hand, damaged."""

import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.toys import PHI, phi
from lare_rl.errors import LareError
from lare_rl.latent.function import HEADER, check_task, normal, verified
from lare_rl.latent.saved import load, read_source

SOURCE = PHI.strip("\n")


def batch(rows: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((rows, 2), np.float32), np.ones((rows, 1), np.float32)


@pytest.mark.parametrize("ending", [".py", ".json"])
def test_saved_and_loaded_it_is_the_same(function, chase, tmp_path, ending):
    function.save(tmp_path / "phi.py")
    loaded = load((tmp_path / "phi").with_suffix(ending), chase)
    assert loaded == function
    np.testing.assert_array_equal(loaded(*batch(3)), [[-1, -1]] * 3)


def test_the_file_is_python_with_its_provenance_on_top(function, tmp_path):
    function.save(tmp_path / "phi")
    assert (tmp_path / "phi.py").read_text() == (
        "# lare: task: Chase\n"
        "# lare: kind: factors\n"
        "# lare: model: Somebody, draw 0\n"
        f"# lare: sha256: {function.digest}\n"
        "# lare: passed: read, finite\n"
        f"{SOURCE}\n"
    )
    assert json.loads((tmp_path / "phi.json").read_text())["exchanges"] == list(function.exchanges)


def test_headers_do_not_pile_up(function, chase, tmp_path, trusting):
    function.save(tmp_path / "phi.py")
    once = (tmp_path / "phi.py").read_text()
    load(tmp_path / "phi.py", chase).save(tmp_path / "phi.py")
    assert (tmp_path / "phi.py").read_text() == once
    assert once.count(HEADER) == 5


def test_a_function_of_ones_own_needs_no_record(chase, sound, tmp_path, trusting):
    (tmp_path / "mine.py").write_text(PHI)
    assert load(tmp_path / "mine.py", chase) == sound


def test_a_function_of_another_task_is_refused_until_the_file_says_otherwise(function, chase, tmp_path):
    other = chase.model_copy(update={"name": "Depot"})
    function.save(tmp_path / "phi.py")
    with pytest.raises(
        LareError, match=r"phi\.py was written for the task 'Chase', and this is 'Depot': .* \"# lare: task: Chase\"$"
    ):
        load(tmp_path / "phi.py", other)
    with pytest.raises(
        LareError, match=r"^the latent function was written for the task 'Chase', and this is 'Depot': "
    ):
        check_task(function, other)
    text = (tmp_path / "phi.py").read_text()
    (tmp_path / "phi.py").write_text(text.replace("# lare: task: Chase\n", ""))
    assert load(tmp_path / "phi.py", other).task == "Depot"


def test_the_header_says_who_wrote_it_where_there_is_no_record(function, chase, tmp_path):
    function.save(tmp_path / "phi.py")
    (tmp_path / "phi.json").unlink()
    assert load(tmp_path / "phi.py", chase).model == function.model


def test_a_source_is_read_without_a_look_into_it(function, tmp_path):
    function.save(tmp_path / "phi.py")
    assert read_source(tmp_path / "phi.py") == read_source(tmp_path / "phi.json") == (SOURCE, False, "Chase")
    (tmp_path / "mine.py").write_text("\ufeff\n\nno Python\n", encoding="utf-8")
    assert read_source(tmp_path / "mine.py") == ("no Python", False, None)
    with pytest.raises(LareError, match=r"the function file .* does not exist"):
        read_source(tmp_path / "none.py")
    (tmp_path / "book.py").write_bytes(b"#" * (2 << 20))
    with pytest.raises(LareError, match="is larger than 1 MB, which is too large for a function"):
        read_source(tmp_path / "book.py")


def test_a_reply_to_a_pasted_request_is_read_as_it_is(chase, sound, tmp_path, trusting):
    """With anything around the object, as a chat shows it."""
    reply = json.dumps({"Understand": "", "Analyze": "", "Functions": PHI})
    path = tmp_path / "reply.json"
    path.write_text(f"Here it is:\n```json\n{reply}\n```\n")
    assert read_source(path) == (SOURCE, False, None)
    loaded = load(path, chase)
    assert (loaded.source, loaded.model) == (SOURCE, "a model that is not named")
    loaded.save(tmp_path / "phi.py")
    assert load(tmp_path / "phi.py", chase).model == "a model that is not named"
    path.write_text('{"Understand": ""}')
    with pytest.raises(
        LareError, match=r"reply\.json is not a model's reply \(.*'Functions'.*\), and .*reply\.py does not exist$"
    ):
        read_source(path)


def test_the_hash_says_whether_a_source_was_changed(function, chase, tmp_path):
    """With the record beside it, and without."""
    path = tmp_path / "phi.py"
    function.save(path)
    assert not load(path, chase).changed
    path.write_text(path.read_text().replace("effort", "exertion"))
    assert read_source(path)[1]
    assert load(path, chase).model == function.model + "; changed by hand since"
    path.with_suffix(".json").unlink()
    assert load(path, chase).changed


@pytest.mark.parametrize(
    "top", ["# lare: x\n\n# lare: kind: reward\n", "\n\n# lare: sha256: 0\n# lare: \n\n\n# lare: y\n"]
)
def test_no_reply_writes_a_header(chase, tmp_path, top):
    """However many there are, one beneath the other: what is saved comes back as what it is."""
    made = verified(top + PHI, chase)
    assert made.source == normal(made.source) == SOURCE
    made.save(tmp_path / "phi.py")
    back = load(tmp_path / "phi.py", chase)
    assert (back.kind, back.source, back.changed) == ("factors", SOURCE, False)


def test_no_name_becomes_a_line_of_code(function, chase, tmp_path):
    replace(function, model="x\nimport os\r\x85import sys\u2028#").save(tmp_path / "phi.py")
    assert load(tmp_path / "phi.py", chase).source == function.source
    top = [line for line in (tmp_path / "phi.py").read_text().splitlines() if line.startswith(HEADER)]
    assert top[2] == f"{HEADER}model: x import os import sys #"


def test_loading_verifies_again(function, chase, tmp_path):
    path = tmp_path / "phi.py"
    function.save(path)
    path.write_text(path.read_text().replace("[f_near, f_effort]", "[f_near, effort]"))
    with pytest.raises(LareError) as error:
        load(path, chase)
    start = f"{path}: the function does not fit task 'Chase': E-RUN line 8: effort is not defined"
    assert str(error.value).startswith(start)


def test_a_change_by_hand_is_noted(function, chase, tmp_path, trusting):
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
    found = f"{path.with_suffix('.py')} does not exist" if name else f"{path} is not a file"
    assert str(error.value) == f"the function file {found}"


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
        ('{"source": "", "model": null, "exchanges": []}', "TypeError('model')"),
        ("[" * 20_000, "ValueError('it is nested more than 64 deep')"),
        ("[]", "TypeError('list indices must be integers or slices, not str')"),
        ('{"source": "", "model": "m", "exchanges": 3}', "TypeError(\"'int' object is not iterable\")"),
    ],
)
def test_a_broken_record_is_refused(function, chase, tmp_path, trusting, record, problem):
    function.save(tmp_path / "phi.py")
    (tmp_path / "phi.json").write_text(record)
    with pytest.raises(LareError) as error:
        load(tmp_path / "phi.py", chase)
    assert str(error.value) == f"{tmp_path / 'phi.json'} is not the record of a latent function: {problem}"


@pytest.mark.parametrize(
    "source", [PHI, "\n" + PHI, PHI.replace("\n", "\r\n"), PHI.replace("effort\n", "effort\x0c\n")]
)
def test_saved_and_loaded_it_is_the_same_whatever_its_line_ends(chase, tmp_path, trusting, source):
    function = verified(source, chase)
    function.save(tmp_path / "phi.py")
    assert load(tmp_path / "phi.py", chase).digest == function.digest


def test_a_reward_stays_a_reward(chase, tmp_path):
    function = verified(phi("return [action]"), chase, "reward")
    function.save(tmp_path / "phi.py")
    assert load(tmp_path / "phi.py", chase) == function


def test_save_nowhere(sound, tmp_path):
    with pytest.raises(LareError, match="cannot be written"):
        sound.save(tmp_path / "none" / "phi.py")

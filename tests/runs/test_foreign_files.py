"""Every file that is read back may be damaged, too large, too deep, of wrong types, or somebody's attempt: one line for each."""

import io
import json
import sys
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.toys import PHI, toy_spec
from lare_rl.config.migrate import FORMAT
from lare_rl.config.resolve import decide
from lare_rl.config.settings import Settings
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.latent.saved import read_source
from lare_rl.llm.model import recorded_model
from lare_rl.report.report import write_report
from lare_rl.runs import checkpoint, directory
from lare_rl.runs.directory import describe, open_run, read_config, read_metrics
from lare_rl.sweep.sweep import read_sweep

DEEP = "[" * 50_000
TOO_DEEP = "it is nested more than 64 deep"
LINE = {"step": 1, "seed": 0, "evaluation/return": 1.5}


def said(read, *arguments) -> str:
    """What is said of a file. Whatever is raised but a `LareError` fails the test."""
    with pytest.raises(LareError) as error:
        read(*arguments)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1000
    return str(error.value)


@pytest.fixture
def run(tmp_path):
    """A run directory that nobody has trained in, with changes of its config.json."""

    def make(task=None, **changes) -> Path:
        spec = toy_spec(**(task or {}))
        config = describe(toy_spec(), decide(Settings(method="dense", steps=100), toy_spec()), ())
        values = json.loads(config.model_dump_json()) | {"task": json.loads(spec.model_dump_json())} | changes
        (tmp_path / "config.json").write_text(json.dumps(values))
        (tmp_path / "metrics.jsonl").write_text(json.dumps(LINE) + "\n")
        return tmp_path

    return make


# --- config.json -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "Expecting value: line 1 column 1 (char 0)"),
        (b'{"format": 3', "Expecting ',' delimiter: line 1 column 13 (char 12)"),
        (DEEP.encode(), TOO_DEEP),
        (b'{"format": ' + b"[" * 988 + b"]" * 988 + b"}", TOO_DEEP),
        (b"[]", "it is JSON, but not an object"),
        (b"null", "it is JSON, but not an object"),
        (b"\xff", "cannot be read: 'utf-8' codec can't decode byte 0xff in position 0: invalid start byte"),
        (b'{"format": ' + b"9" * 5000 + b"}", "a number of 5000 digits"),
        (
            f'{{"format": {FORMAT}}}'.encode(),
            "the keys 'lare', 'settings', 'task', 'task_sha256', 'longest_episode', 'function_sha256', 'versions', "
            "'machine' are missing",
        ),
        (b'{"format": 1, "lare": "0.1"}', "the run is of another version of LaRe (0.1), whose files this one does not read: "
                                         "use that version, or train it again"),
    ],
)  # fmt: skip
def test_config(tmp_path, content, message):
    (tmp_path / "config.json").write_bytes(content)
    assert said(read_config, tmp_path).endswith(f"config.json{' ' if message.startswith('cannot') else ': '}{message}")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"longest_episode": "many"},
         "longest_episode = 'many': input should be a valid integer, unable to parse string as an integer"),
        ({"settings": []}, "settings = []: should be a table of settings, such as {'KEY': VALUE}"),
        ({"versions": {"jax": {}}}, "versions.jax = {}: input should be a valid string"),
        ({"more": 1}, "there is no key 'more'"),
    ],
)  # fmt: skip
def test_config_of_wrong_types(run, changes, message):
    assert said(read_config, run(**changes)).endswith(f"config.json: {message}")


def test_config_asks_for_no_more_seeds_than_there_are(run):
    place = run()
    values = json.loads((place / "config.json").read_text())
    values["settings"]["seeds"] = 2_000_000_000
    (place / "config.json").write_text(json.dumps(values))
    assert "seeds = 2000000000: input should be less than or equal to 1000" in said(read_config, place)


def test_config_of_any_size(run, monkeypatch):
    monkeypatch.setattr(directory, "LARGEST_CONFIG", 1 << 20)
    assert said(read_config, run(machine="x" * (1 << 20))).endswith("config.json is larger than 1 MB")


# --- metrics.jsonl ---------------------------------------------------------------------------------------------------

NO_EVALUATION = "is damaged: line 2 is no evaluation"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (DEEP, f"is damaged: {TOO_DEEP} in line 2"),
        ("{", "is damaged: Expecting property name enclosed in double quotes: line 1 column 2 (char 1) in line 2"),
        ("9" * 5000, "is damaged: a number of 5000 digits in line 2"),
        ("[]", NO_EVALUATION),
        (json.dumps(LINE | {"step": True}), NO_EVALUATION),
        (json.dumps(LINE | {"step": -1}), NO_EVALUATION),
        (json.dumps(LINE | {"step": 1.5}), NO_EVALUATION),
        (json.dumps(LINE | {"step": 10**400}), NO_EVALUATION),
        (json.dumps(LINE | {"seed": "0"}), NO_EVALUATION),
        (json.dumps(LINE | {"evaluation/return": "<script>"}), NO_EVALUATION),
        (json.dumps(LINE | {"evaluation/return": [1]}), NO_EVALUATION),
        (json.dumps(LINE | {"evaluation/return": 10**400}), NO_EVALUATION),
    ],
)
def test_metrics(run, line, message):
    place = run()
    with (place / "metrics.jsonl").open("a") as file:
        file.write(line + "\n")
    assert said(read_metrics, place) == f"{place / 'metrics.jsonl'} {message}"
    assert said(write_report, [place]) == f"{place / 'metrics.jsonl'} {message}"


def test_metrics_of_any_size(run, monkeypatch):
    monkeypatch.setattr(directory, "LARGEST_METRICS", 1 << 20)
    place = run()
    (place / "metrics.jsonl").write_text("x" * (2 << 20))
    assert said(read_metrics, place).endswith("metrics.jsonl is larger than 1 MB")


def test_a_line_that_has_no_end_yet_is_none(run):
    place = run()
    with (place / "metrics.jsonl").open("a") as file:
        file.write('{"step": 2')
    assert read_metrics(place) == [LINE]


# --- state.npz -------------------------------------------------------------------------------------------------------


class Held(NamedTuple):
    columns: Any
    next_row: Any


class Learner(NamedTuple):
    replay: Held


def saved(place: Path, **changes) -> Path:
    """A checkpoint with other arrays in it."""
    checkpoint.save(place, Learner(Held({"reward": jnp.zeros((1, 1, 16))}, jnp.full((1, 1), 3))), {"step": 3}, {})
    with np.load(place / "state.npz") as state:
        arrays = dict(state) | changes
    np.savez(place / "state.npz", **arrays)
    return place


def load(place: Path):
    return checkpoint.load(place, Learner(Held({"reward": jnp.zeros((1, 1, 16))}, jnp.zeros((1, 1), int))))


def host(**values) -> np.ndarray:
    return np.array(json.dumps({"step": 3} | values))


def segments(**values) -> np.ndarray:
    return np.array(json.dumps([{"number": 0, "start": [[0]], "count": [[4]]} | values]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"host": np.array(DEEP)}, TOO_DEEP),
        ({"host": np.array("[]")}, "host is no object"),
        ({"host": np.zeros(3)}, "Expecting ',' delimiter: line 1 column 3 (char 2)"),
        ({"host": host(step="3")}, "'3' is not a count"),
        ({"host": host(step=-1)}, "-1 is not a count"),
        ({"host": host(metrics_length=2**60)}, "1152921504606846976 is not a count"),
        ({"host": host(functions_since="../../other")}, "'../../other' is not a count"),
        ({"host": host(function_sha256=[1])}, "function_sha256 is no list of texts"),
        ({"segments": np.array("3")}, "'int' object is not iterable"),
        ({"segments": np.array("[{}]")}, "'number'"),
        ({"segments": segments(number="../../../etc/passwd")}, "'../../../etc/passwd' is not a count"),
        ({"segments": segments(start=[[-5]])}, "-5 is not a count"),
        ({"segments": segments(count=[[10**15]])}, None),
        ({"segments": segments(count=[[[[4]]]])}, None),
        ({"segments": segments(number=7)}, None),
        ({".replay.next_row": np.zeros((1, 1), "U5")}, ".replay.next_row holds <U5, not int32"),
        ({".replay.next_row": np.zeros((1, 1), float)}, ".replay.next_row holds float64, not int32"),
        ({".replay.next_row": np.zeros((2, 9), int)}, ".replay.next_row has shape (2, 9), not (1, 1)"),
        ({".replay.next_row": np.array([[{}]], object)},
         "Object arrays cannot be loaded when allow_pickle=False"),
    ],
)  # fmt: skip
def test_state(tmp_path, changes, message):
    place = saved(tmp_path / "checkpoint", **changes)
    found = said(load, place)
    assert found.startswith(f"the checkpoint {place / 'state.npz'} cannot be read: ")
    assert message is None or found.endswith(f"cannot be read: {message}")


def header(shape: tuple) -> bytes:
    """An array without its numbers."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return file.getvalue()


@pytest.mark.parametrize("shape", [(10**15,), (10**11,), (2**62, 4), (-1,)])
def test_state_that_says_it_is_larger_than_it_is(tmp_path, shape):
    place = saved(tmp_path / "checkpoint")
    with zipfile.ZipFile(place / "state.npz", "a") as archive:
        archive.writestr("latest/more.npy", header(shape))
    assert said(load, place).startswith(f"the checkpoint {place / 'state.npz'} cannot be read: ")


def test_state_that_unpacks_to_a_lot(tmp_path):
    place = saved(tmp_path / "checkpoint")
    with zipfile.ZipFile(place / "state.npz", "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("latest/more.npy", header((1 << 24,)) + b"\0" * (8 << 24))
    assert said(load, place).endswith("latest/more.npy is packed, which no checkpoint is")
    assert checkpoint.saved_host(place) is None


@pytest.mark.parametrize("content", [b"", b"PK", b"\x93NUMPY\x01\x00" + b"\xff" * 99, header((3,)), b"\x80\x04."])
def test_state_that_is_no_archive(tmp_path, content):
    place = saved(tmp_path / "checkpoint")
    (place / "state.npz").write_bytes(content)
    assert said(load, place).startswith(f"the checkpoint {place / 'state.npz'} cannot be read: ")


# --- recordings, sweeps, task files ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is not JSON: Expecting value: line 1 column 1 (char 0)"),
        (DEEP, f"is not JSON: {TOO_DEEP}"),
        ('{"task": ' + "[" * 988 + "]" * 988 + "}", f"is not JSON: {TOO_DEEP}"),
        ("[]", "is JSON, but not an object"),
        ('{"task": "\\ud800"}', "holds half a character (a surrogate), which no file can keep"),
        (
            '{"task": 3}',
            ": task = 3: input should be a valid string; the keys 'kind', 'draw', 'model', 'recorded', 'temperature', "
            "'exchanges' are missing",
        ),
    ],
)
def test_recordings(tmp_path, content, message):
    path = tmp_path / "talk.json"
    path.write_text(content)
    assert (
        said(recorded_model, "Chase", "factors", 0, path)
        == f"recording {path}{'' if message[0] == ':' else ' '}{message}"
    )


@pytest.mark.parametrize("read", [read_task, read_sweep])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (f"x = {DEEP}", TOO_DEEP),
        ("a." * 200_000 + "a = 1", TOO_DEEP),
        ("x = {" * 100 + "}" * 100, TOO_DEEP),
        ("x", "Expected '=' after a key in a key/value pair (at end of document)"),
        (f"x = {'9' * 5000}", None),
        ("", None),
        ("name = 3\ntasks = {}", None),
    ],
)
def test_tasks_and_sweeps(tmp_path, read, content, message):
    path = tmp_path / "file.toml"
    path.write_text(content)
    found = said(read, path)
    assert message is None or found.endswith(message)


@pytest.mark.parametrize("read", [read_task, read_sweep])
def test_tasks_and_sweeps_of_any_size(tmp_path, read):
    path = tmp_path / "file.toml"
    path.write_text("#" * (2 << 20))
    assert said(read, path).endswith(f"{path} is larger than 1 MB")


# --- a task file is code ---------------------------------------------------------------------------------------------


@pytest.fixture
def neighbour(tmp_path, monkeypatch):
    """A module in a folder of this user's that says when it is run."""
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "a_neighbours_file.py").write_text("raise SystemExit('it was run')")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delenv("LARE_TRUST", raising=False)
    return folder / "a_neighbours_file.py"


@pytest.mark.parametrize("environment", ["a_neighbours_file:X-v0", "pettingzoo/a_neighbours_file:make"])
def test_a_run_directory_imports_no_file_that_nobody_named(run, neighbour, monkeypatch, environment):
    place = run({"environment": environment})
    assert said(open_run, place) == (
        f"{place}: its environment {environment!r} would run {neighbour.resolve()}, which belongs to no installed package; "
        "if you trust that file, set LARE_TRUST=a_neighbours_file"
    )
    monkeypatch.setenv("LARE_TRUST", "other, a_neighbours_file")
    assert open_run(place).config.task.environment == environment


@pytest.mark.parametrize(
    "environment", ["a_neighbours_file:X-v0", "pettingzoo/a_neighbours_file:make", "this:X", "antigravity:X"]
)
def test_a_report_imports_nothing_that_a_file_names(run, neighbour, environment):
    place, before = run({"environment": environment}), {*sys.modules}
    page = write_report([place]).read_text(encoding="utf-8")
    module = environment.removeprefix("pettingzoo/").partition(":")[0]
    assert f"Its environment is of the module {module}, which is not imported for a report." in page
    assert module not in {*sys.modules} - before


def test_such_a_report_prints_the_latent_function_that_is_in_use(run, neighbour):
    place = run({"environment": "a_neighbours_file:X-v0"})
    function = place / "latent_function.py"
    function.write_text(PHI)
    run({"environment": "a_neighbours_file:X-v0"}, function_sha256=[read_source(function).digest])
    assert "# 1. how near the action comes" in write_report([place]).read_text(encoding="utf-8")
    function.write_text(PHI.replace("near", "far"))
    assert said(lambda one: write_report([one]), place).endswith(
        "latent_function.py is not the function that this run was trained with: its hash changed"
    )


def test_the_command_says_what_a_report_leaves_out(run, neighbour, command):
    place = run({"environment": "a_neighbours_file:X-v0"})
    left_out = (
        "drawing, which takes up to a minute for each run\n"
        "the module a_neighbours_file was not imported, so random play, credit and factors are left out: "
        "set LARE_TRUST=a_neighbours_file to allow the import\n"
    )
    status, _, noted = command("report", place)
    assert (status, noted) == (0, left_out)
    (place / "report.html").write_text("complete")
    status, _, noted = command("report", place)
    assert (status, noted) == (
        2,
        f"lare-rl: {place}/report.html would be replaced by a page without random play, credit and factors, because the module "
        "a_neighbours_file is not imported: set LARE_TRUST=a_neighbours_file, or write another file with --out\n",
    )
    assert (place / "report.html").read_text() == "complete"
    status, _, noted = command("report", place, "--out", place / "poorer.html")
    assert (status, noted) == (0, left_out)


def test_what_is_installed_or_here_already_is_no_neighbours_file(run):
    assert open_run(run({"environment": "helpers.toys:toys/Chase-v0"})).functions == ()
    assert open_run(run({"environment": "json:X"})).functions == ()
    assert open_run(run({"environment": "nowhere_at_all:X"})).functions == ()


def test_html_is_escaped(run):
    place = run(machine="<script>alert(1)</script>", lare="<img src=x>")
    page = write_report([place]).read_text(encoding="utf-8")
    assert "<script" not in page
    assert "<img" not in page


def test_functions_for_other_roles(run):
    assert said(open_run, run(function_sha256=["0" * 64, "1" * 64])).endswith(
        "there are 2 latent functions for 1 roles"
    )

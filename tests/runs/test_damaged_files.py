"""Every file that is read may be damaged, too large, too deep, of wrong types, or an attack: the error is one line."""

import io
import json
import re
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.untrained_runs import LINE, write_changed_run
from lare_rl.config.migrate import FORMAT
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.report.report import write_report
from lare_rl.runs import checkpoint, metrics_file
from lare_rl.runs.config_file import MAX_CONFIG_BYTES, read_config
from lare_rl.runs.directory import open_run
from lare_rl.runs.metrics_file import read_metrics
from lare_rl.sweep.sweep import read_sweep

DEEP = "[" * 50_000
TOO_DEEP = "nested more than 64 deep"


def refusal(read, *arguments) -> str:
    """Return the message of the `LareError` that a reader raises. Any other exception fails the test."""
    with pytest.raises(LareError) as error:
        read(*arguments)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1000
    return str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "line 1 column 1"),
        (DEEP.encode(), TOO_DEEP),
        (b"[]", "not an object"),
        (f'{{"format": {FORMAT}}}'.encode(), "'lare', 'settings', 'task'"),
        (b'{"format": 1, "lare": "0.1"}', "another version of LaRe (0.1)"),
        (b'{"lare": "0.1"}', "no 'format'"),
        (b"x" * (MAX_CONFIG_BYTES + 1), "is larger than 8 MB"),
    ],
)
def test_config_content(tmp_path, content, message):
    (tmp_path / "config.json").write_bytes(content)
    text = refusal(read_config, tmp_path)
    assert "config.json" in text
    assert message in text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"longest_episode": 0}, "longest_episode = 0"),
        ({"settings": {"seeds": 2_000_000_000}}, "seeds = 2000000000"),
        ({"versions": {"jax": {}}}, "versions.jax = {}"),
        ({"more": 1}, "'more'"),
        ({"function_sha256": ["0" * 64, "1" * 64]}, "2 latent functions for 1 roles"),
    ],
)
def test_config_values(tmp_path, changes, message):
    settings = json.loads((write_changed_run(tmp_path) / "config.json").read_text())["settings"]
    changes = {name: settings | value if name == "settings" else value for name, value in changes.items()}
    assert message in refusal(open_run, write_changed_run(tmp_path, **changes))


def test_html_is_escaped(tmp_path):
    run = write_changed_run(tmp_path, machine="<script>alert(1)</script>", lare="<img src=x>")
    page = write_report([run]).read_text("utf-8")
    assert "<script" not in page
    assert "<img" not in page


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (DEEP, TOO_DEEP),
        ("{", "line 2 is not valid JSON: Expecting"),
        ("[]", "line 2 is no evaluation"),
        *((json.dumps(LINE | {"step": step}), "line 2 is no evaluation") for step in (True, -1, 1.5, 10**400)),
        *((json.dumps(LINE | {name: "0"}), "line 2 is no evaluation") for name in ("seed", "evaluation/return")),
        *((json.dumps(LINE | {"evaluation/return": x}), "line 2 is no evaluation") for x in ([1], 10**400)),
    ],
)
def test_metrics_line(tmp_path, line, message):
    directory = write_changed_run(tmp_path)
    with (directory / "metrics.jsonl").open("a") as file:
        file.write(line + "\n")
    for text in (refusal(read_metrics, directory), refusal(write_report, [directory])):
        assert "metrics.jsonl is damaged" in text
        assert message in text


def test_metrics_size_and_incomplete_line(tmp_path, monkeypatch):
    monkeypatch.setattr(metrics_file, "MAX_METRICS_BYTES", 1 << 20)
    path = write_changed_run(tmp_path) / "metrics.jsonl"
    path.write_text(path.read_text() + '{"step": 2')
    assert read_metrics(tmp_path) == [LINE]
    path.write_text("x" * (2 << 20))
    assert "metrics.jsonl is larger than 1 MB" in refusal(read_metrics, tmp_path)


class Replay(NamedTuple):
    columns: Any
    next_row: Any


class Learner(NamedTuple):
    replay: Replay


def make_learner(next_row):
    return Learner(Replay({"reward": jnp.zeros((1, 1, 16))}, jnp.full((1, 1), next_row)))


def check_refused(directory: Path, message: str = "") -> None:
    text = refusal(checkpoint.load, directory, make_learner(0))
    assert text.startswith(f"the checkpoint {directory / 'state.npz'} cannot be read: ")
    assert message in text


@pytest.fixture
def directory(tmp_path) -> Path:
    """A checkpoint."""
    checkpoint.write(tmp_path, checkpoint.take_snapshot(tmp_path, make_learner(3), {"step": 3}, {}))
    return tmp_path


def host(**values) -> np.ndarray:
    return np.array(json.dumps({"step": 3} | values))


def segments(**values) -> np.ndarray:
    return np.array(json.dumps([{"number": 0, "start": [[0]], "count": [[4]]} | values]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"host": np.array(DEEP)}, TOO_DEEP),
        ({"host": np.array("[]")}, "not an object"),
        ({"host": np.zeros(3)}, "line 1 column 3"),
        ({"host": np.array("{}")}, "'step'"),
        ({"host": host(step="3")}, "'3' is not a count"),
        ({"host": host(step=-1)}, "-1 is not a count"),
        ({"host": host(metrics_length=2**60)}, "is not a count"),
        ({"host": host(function_sha256=[1])}, "function_sha256 is no list"),
        ({"segments": np.array("3")}, "not iterable"),
        ({"segments": np.array("[{}]")}, "'number'"),
        ({"segments": segments(number="../../../etc/passwd")}, "'../../../etc/passwd' is not a count"),
        ({"segments": segments(start=[[-5]])}, "-5 is not a count"),
        ({"segments": segments(count=[[10**15]])}, "rows-0.npz does not fit"),
        ({"segments": segments(count=[[5]])}, "rows-0.npz does not fit"),
        ({"segments": segments(count=[[[[4]]]])}, "indices"),
        ({"segments": segments(number=7)}, "rows-7.npz"),
        ({".replay.next_row": np.zeros((1, 1), "U5")}, ".replay.next_row holds <U5, not int32"),
        ({".replay.next_row": np.zeros((1, 1), float)}, ".replay.next_row holds float64, not int32"),
        ({".replay.next_row": np.zeros((2, 9), int)}, ".replay.next_row has shape (2, 9), not (1, 1)"),
        ({".replay.next_row": np.array([[{}]], object)}, "allow_pickle=False"),
    ],
)
def test_state_values(directory, changes, message):
    with np.load(directory / "state.npz") as state:
        arrays = dict(state) | changes
    np.savez(directory / "state.npz", **arrays)
    check_refused(directory, message)


def header(shape: tuple) -> bytes:
    """Return an array file without its numbers."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return file.getvalue()


@pytest.mark.parametrize(
    "content", [header((10**15,)), header((3,)).replace(b"(3,), }" + b" " * 20, b"1" + b"+1" * 13)]
)
def test_state_with_false_header(directory, content):
    with zipfile.ZipFile(directory / "state.npz", "a") as archive:
        archive.writestr("latest/more.npy", content)
    check_refused(directory)


def test_state_that_is_no_plain_archive(directory):
    content = bytearray((directory / "state.npz").read_bytes())
    with zipfile.ZipFile(directory / "state.npz", "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("latest/more.npy", header((1 << 24,)) + b"\0" * (8 << 24))
    check_refused(directory, "latest/more.npy is compressed")
    assert checkpoint.read_metadata(directory) is None
    content[content.index(b"PK\x01\x02") + 8] |= 1
    (directory / "state.npz").write_bytes(content)
    check_refused(directory, "encrypted")
    for content in (b"", b"PK", b"PK\x03\x04" + b"\xff" * 99, header((0,)), b"\x80\x04."):
        (directory / "state.npz").write_bytes(content)
        check_refused(directory, "no .npz file")


@pytest.mark.parametrize("read", [read_task, read_sweep])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (f"x = {DEEP}", TOO_DEEP),
        ("x", "Expected '='"),
        ("", "missing|required"),
        ("name = 3\ntasks = {}", "name|tasks"),
    ],
)
def test_task_or_sweep(tmp_path, read, content, message):
    path = tmp_path / "file.toml"
    path.write_text(content)
    assert re.search(message, refusal(read, path))

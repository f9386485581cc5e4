"""Function files: saved, loaded, changed by hand, damaged."""

import hashlib
import json
from dataclasses import replace

import pytest

from helpers.toy_envs import PHI, phi_source
from lare_rl.errors import LareError
from lare_rl.latent.function import verify_function
from lare_rl.latent.saved import load_function, read_source

SOURCE = PHI.strip("\n")


@pytest.fixture
def path(function, tmp_path):
    """The file of a saved function."""
    function.save(tmp_path / "phi")
    return tmp_path / "phi.py"


def test_save_and_load(function, path, verified, chase):
    header = [
        "task: Chase",
        "kind: factors",
        "model: A model, draw 0",
        f"sha256: {hashlib.sha256(SOURCE.encode()).hexdigest()}",
        "passed: read, finite",
    ]
    assert path.read_text() == "".join(f"# lare: {line}\n" for line in header) + SOURCE + "\n"
    assert json.loads(path.with_suffix(".json").read_text())["exchanges"] == list(function.exchanges)
    content = path.read_text()
    assert load_function(path.with_suffix(".json"), chase) == load_function(path, chase) == function
    load_function(path, chase).save(path)
    assert path.read_text() == content
    path.with_suffix(".json").unlink()
    assert load_function(path, chase).model == function.model
    path.write_text(PHI)
    assert load_function(path, chase) == verified
    path.write_text(content.replace("[f_near, f_effort]", "[f_near, effort]"))
    with pytest.raises(LareError, match=r"phi\.py: .*'Chase': E-RUN line 8: effort"):
        load_function(path, chase)
    reward = verify_function(phi_source("return [action]"), chase, "reward")
    reward.save(path)
    assert load_function(path, chase) == reward


def test_other_task_and_names_of_models(chase, path, function):
    other = chase.model_copy(update={"name": "Depot"})
    with pytest.raises(LareError, match=r"phi\.py .*'Chase', not for 'Depot'.*\"# lare: task: Chase\""):
        load_function(path, other)
    path.write_text(path.read_text().replace("# lare: task: Chase\n", ""))
    assert load_function(path, other).task == "Depot"
    replace(function, model="x\nimport os\r\x85import sys\u2028#").save(path)
    assert load_function(path, chase).source == function.source
    assert path.read_text().splitlines()[2] == "# lare: model: x import os import sys #"
    replace(function, model="m\udcff").save(path)  # a name that no file can have
    assert load_function(path, chase) == replace(function, model="m\\udcff")


def test_read_source_and_reply_of_a_chat(path, tmp_path, chase):
    assert read_source(path) == read_source(path.with_suffix(".json")) == (SOURCE, False, "Chase")
    path.write_text("\ufeff\n\nno Python\n", encoding="utf-8")
    assert read_source(path) == ("no Python", False, None)
    reply = json.dumps({"Understand": "", "Analyze": "", "Functions": PHI})
    path = tmp_path / "reply.json"
    path.write_text(f"Here it is:\n```json\n{reply}\n```\n")
    assert read_source(path) == (SOURCE, False, None)
    loaded = load_function(path, chase)
    assert (loaded.source, loaded.model) == (SOURCE, "a model that is not named")
    loaded.save(tmp_path / "phi.py")
    assert load_function(tmp_path / "phi.py", chase).model == "a model that is not named"
    (tmp_path / "reply.txt").write_text(PHI)  # reply.json is not the record of this file
    assert load_function(tmp_path / "reply.txt", chase).exchanges == ()


@pytest.mark.parametrize("with_record", [True, False])
def test_source_changed_by_hand(function, chase, path, with_record):
    if not with_record:
        path.with_suffix(".json").unlink()
    assert not load_function(path, chase).changed
    path.write_text(path.read_text().replace("# 2. effort", "# 2. exertion"))
    assert read_source(path).changed
    loaded = load_function(path, chase)
    assert loaded.changed
    assert loaded.model == "A model, draw 0; changed by hand since"
    assert loaded.exchanges == (function.exchanges if with_record else ())
    assert loaded.meanings[1] == "exertion"
    loaded.save(path)
    path.write_text(path.read_text().replace("# 2. exertion", "# 2. work"))
    assert load_function(path, chase).model == loaded.model  # the note is there once


@pytest.mark.parametrize(
    "top", ["# lare: x\n\n# lare: kind: reward\n", "\n\n# lare: sha256: 0\n# lare: \n\n\n# lare: y\n"]
)
def test_header_in_a_reply(chase, path, top):
    function = verify_function(top + PHI, chase)
    assert function.source == SOURCE
    function.save(path)
    loaded = load_function(path, chase)
    assert (loaded.kind, loaded.source, loaded.changed) == ("factors", SOURCE, False)


@pytest.mark.parametrize("top", ["\n", "# a note\n", "# a note\n\n"])
def test_header_below_other_lines(chase, function, path, top):
    function.save(path)
    text = path.read_text()
    path.write_text(top + text)
    loaded = load_function(path, chase)
    assert loaded.source == top.lstrip("\n") + SOURCE
    assert loaded.changed == bool(top.strip())
    path.write_text(top + text.replace("kind: factors", "kind: Reward"))
    with pytest.raises(LareError, match=r"'Reward'.*factors or reward"):
        load_function(path, chase)


def test_names_of_files(function, tmp_path, monkeypatch):
    names = {"a": "a.py", "b.json": "b.py", "phi.v2": "phi.v2.py", "phi-0.5.py": "phi-0.5.py"}
    for name, file in names.items():
        function.save(tmp_path / name)
        assert (tmp_path / file).exists()
        assert (tmp_path / file).with_suffix(".json").exists()
        assert read_source(tmp_path / name).source == function.source
    assert len(list(tmp_path.iterdir())) == 2 * len(names)
    monkeypatch.chdir(tmp_path)
    for path, words in (("none/phi.py", "cannot be written"), ("", "not the name"), ("..", "not the name")):
        with pytest.raises(LareError, match=words):
            function.save(path)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.py", None, r"missing\.py does not exist"),
        ("missing.json", None, r"missing\.json does not exist, nor missing\.py"),
        ("", None, "not a file"),
        ("phi.py", b"\xff", "0xff"),
        ("phi.py", b"#" * (2 << 20), "larger than 1 MB"),
        ("reply.json", b'{"Understand": ""}', r"not a model's reply .*'Functions'.*reply\.py does not exist"),
    ],
)
def test_unreadable_file(chase, tmp_path, name, content, words):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(LareError, match=words):
        read_source(tmp_path / name)
    with pytest.raises(LareError, match=words):
        load_function(tmp_path / name, chase)


@pytest.mark.parametrize(
    "record",
    [
        *("{", "{}", "[" * 20_000, "[]", '{"source": "", "model": null, "exchanges": []}'),
        '{"source": "", "model": "m", "exchanges": 3}',
        '{"source": "\\ud800", "model": "m", "exchanges": []}',
    ],
)
def test_broken_record(chase, path, record):
    path.with_suffix(".json").write_text(record)
    with pytest.raises(LareError, match=r"phi\.json does not describe phi\.py"):
        load_function(path, chase)

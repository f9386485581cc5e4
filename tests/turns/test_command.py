"""The command `turn-credit`: files of rollouts, the page, and mistakes of one line."""

import json
import re

import pytest

from helpers.turn_toys import sample_table, table_rollouts
from lare_rl.errors import LareError
from lare_rl.turns.files import read_rollout_file

PHI = "def turn_events(tool, arguments, result, text):\n    return {'works': 'ok' in result}\n"


@pytest.fixture
def rollouts():
    """Return rollouts with messages, in which a tool works or fails."""
    result = []
    for k, plain in enumerate(table_rollouts(sample_table(n_groups=8))):
        messages = [{"role": "user", "content": "<b>Go</b>"}]
        for turn in plain["turns"]:
            answer = "ok" if turn["event 0"] else "nothing"
            call = {"id": "1", "function": {"name": "try", "arguments": "{}"}}
            messages += [{"role": "assistant", "content": None, "tool_calls": [call]}]
            messages += [{"role": "tool", "tool_call_id": "1", "content": answer}]
        result.append({**plain, "messages": messages, "note": k})
    return result


@pytest.fixture
def file(tmp_path, rollouts):
    path = tmp_path / "rollouts.jsonl"
    path.write_text("\n\n".join(map(json.dumps, rollouts)) + "\n")
    return path


def test_command(command, tmp_path, file, rollouts):
    out, page, phi = tmp_path / "credited.jsonl", tmp_path / "page.html", tmp_path / "phi.py"
    phi.write_text(PHI)
    status, text, _ = command("turn-credit", file, "--out", out, "--report", page, "--function", phi)
    assert status == 0
    assert "GRPO: " in text.splitlines()[0]
    credited = [json.loads(line) for line in out.read_text().splitlines()]
    for before, after in zip(rollouts, credited, strict=True):
        credit = after.pop("credit")
        assert after == before
        assert all(
            len(credit[name]) == len(before["turns"]) for name in ("advantage", "progress", "deviation", "value")
        )
        assert sum(credit["progress"]) == pytest.approx(before["outcome"] - credit["value"][0], abs=1e-4)
    html = page.read_text()
    assert "works" in html
    assert html.count("<svg") == 6
    for source, target, words in (
        (file, out, "--overwrite"),
        (tmp_path / "none.jsonl", tmp_path / "out.jsonl", "none.jsonl"),
        (file, tmp_path / "none" / "out.jsonl", "no directory"),
    ):
        status, _, error = command("turn-credit", source, "--out", target)
        assert (status, error.count("\n"), words in error) == (2, 1, True)
    status, _, error = command("turn-credit", file, "--out", tmp_path / "new", "--report", tmp_path / "new")
    assert (status, "another --report" in error) == (2, True)
    assert not (tmp_path / "new").exists()
    for option, path in (("--report", file), ("--report", phi), ("--out", phi)):
        files = {"--out": tmp_path / "new", "--report": tmp_path / "page"} | {option: path}
        content, flags = path.read_bytes(), [word for pair in files.items() for word in pair]
        status, _, error = command("turn-credit", file, *flags, "--function", phi, "--overwrite")
        assert (status, f"another {option}" in error, path.read_bytes() == content) == (2, True, True)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", ["no rollouts"]),
        ("{}\n[1]\n", ["line 2", "JSON object"]),
        ('{"a": \n', ["line 1", "JSON object", "Expecting"]),
        (b"\xff\xfe{}\n", ["line 1", "JSON object", "decode"]),
        ("[" * 100_000, ["line 1", "JSON object", "deep"]),
    ],
)
def test_bad_files(tmp_path, content, words):
    path = tmp_path / "bad.jsonl"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(LareError) as error:
        read_rollout_file(path)
    assert all(word in str(error.value) for word in words)
    assert "\n" not in str(error.value)
    assert len(re.findall(r"line \d", str(error.value))) <= 1


def test_turn_phi_prints_the_request(command, tmp_path, file):
    tools = tmp_path / "tools.json"
    tools.write_text('[{"type": "function", "function": {"name": "try", "description": "Tries."}}]')
    options = ["--tools", tools, "--goal", "Make it work."]
    status, text, _ = command("turn-phi", file, *options)
    assert status == 0
    assert all(
        words in text for words in ("--- system ---", "find_numbers", "Make it work.", "## try\nTries.", '"nothing"')
    )
    tools.write_text("{}")
    status, _, error = command("turn-phi", file, *options)
    assert (status, "list of tools" in error) == (2, True)


def test_turn_phi_asks_a_model(monkeypatch, command, tmp_path, file):
    reply = json.dumps({"Understand": "", "Analyze": "", "Functions": PHI})
    monkeypatch.setattr("lare_rl.llm.live.LiveModel.reply", lambda self, messages, sample: reply)
    monkeypatch.setattr("lare_rl.llm.live.LiveModel.__post_init__", lambda self: None)
    tools, out = tmp_path / "tools.json", tmp_path / "new.py"
    tools.write_text('[{"name": "try"}]')
    options = ["--tools", tools, "--goal", "Make it work.", "--model", "some", "--out", out]
    assert command("turn-phi", file, *options)[0] == 0
    assert out.read_text().endswith(PHI)
    assert json.loads(out.with_suffix(".json").read_text())["kind"] == "events"
    for target, words in ((out, "not overwritten"), (tmp_path / "none" / "a.py", "no directory")):
        status, _, error = command("turn-phi", file, *options[:-1], target)
        assert (status, words in error) == (2, True)
    assert command("turn-credit", file, "--out", tmp_path / "c.jsonl", "--function", out)[::2] == (0, "")
    reply, attempts = "no function", tmp_path / "turns.attempts.json"
    monkeypatch.chdir(tmp_path)
    status, _, error = command("turn-phi", file, *options[:-2])
    assert (status, "attempts passed" in error, attempts.name in error) == (1, True, True)
    assert attempts.read_text().count("no function") > 1

"""From a live model to a trained policy: a server on loopback gives the recorded replies."""

import errno
import itertools
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from helpers.chat_servers import Server, refuse, reply_with, request_messages
from helpers.scripted_model import to_reply
from helpers.toy_envs import PHI, toy_spec
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.latent.design import design
from lare_rl.latent.saved import load_function
from lare_rl.llm.recording import read_recording, shipped_recordings

REACHER_PHI = "def evaluation_func(o, a):\n    return [np.sum(a**2, axis=1, keepdims=True), o[:, 8:9]]"

KEY = "sk-a-key-that-nobody-may-see"


def recorded_answers(handler) -> None:
    """Give the recorded replies to a request, each once."""
    messages = request_messages(handler.server.requests[-1])
    for recording in shipped_recordings("factors", 0):
        for exchange in recording.exchanges:
            if exchange.messages == messages:
                times = sum(request_messages(request) == messages for request in handler.server.requests)
                return reply_with(exchange.replies[times - 1])(handler)
    return refuse(404, "not recorded")(handler)


@pytest.fixture
def serve(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    servers = []

    def start(*answers) -> Server:
        servers.append(Server(*answers))
        return servers[-1]

    yield start
    for server in servers:
        server.stop()


@pytest.fixture
def design_live(serve, command):
    """Return a function that runs `lare-rl design Reacher-v4` with a model behind a server."""

    def run(server, *options):
        return command("design", "Reacher-v4", "--model", "m", "--base-url", server.url, *options)

    return run


def saved_stages(path) -> list[str]:
    return [exchange.stage for exchange in read_recording(path.read_text(), path.name).exchanges]


@pytest.mark.long
def test_live_model_to_trained_policy(serve, command, design_live, tmp_path):
    server = serve(recorded_answers)
    status, out, err = design_live(server, "--record", "talk.json", "--price", 1, 2, "--out", "phi.py")
    assert status == 0
    assert out.startswith("wrote phi.py: ")
    assert err.splitlines()[-1] == "m: 6 requests, 600 tokens in, 60 out, 0.0007 by the given prices"
    task = read_task("Reacher-v4")
    live, recorded = load_function(tmp_path / "phi.py", task), design(task)
    assert (live.source, live.model) == (recorded.source, "m")

    # The recording can be used again.
    recording = read_recording((tmp_path / "talk.json").read_text(), "talk.json")
    assert (recording.model, recording.task) == ("m", "Reacher-v4")
    assert [exchange.model_dump() for exchange in recording.exchanges] == list(recorded.exchanges)
    status, out, _ = command("design", "Reacher-v4", "--model", "talk.json")
    assert (status, out) == (0, recorded.source + "\n")
    assert len(server.requests) == 6

    # A file that exists is not overwritten.
    status, out, err = design_live(server, "--record", "talk.json")
    assert status == 2
    assert "choose another --record" in err
    assert read_recording((tmp_path / "talk.json").read_text(), "talk.json") == recording

    small = (
        "--steps 100 --rollout-steps 50 --evaluate-every 100 --evaluation-episodes 1 --td3.warmup 50 --td3.hidden 8 8"
    )
    arguments = f"train Reacher-v4 --function phi.py --out run --method lare-linear {small}".split()
    assert command(*arguments)[0] == 0
    assert not any(KEY.encode() in path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())


@pytest.mark.parametrize(
    ("text", "options", "status", "words", "n_replies"),
    [
        ("I would rather talk about something else.", [], 1, ["not one JSON object"], 5),
        ("\x1b[31mno", ["--requests", 2], 2, ["the budget of 2 requests is spent"], 2),
        (
            to_reply("x = np.load('a')\ny = np.fromfile('b')"),
            ["--record", "talk.json"],
            1,
            ["Reacher-v4: ", "E-NUMPY line 1", " (and 1 more)"],
            5,
        ),
    ],
)
def test_replies_are_saved(serve, design_live, tmp_path, text, options, status, words, n_replies):
    """In the file of --record, or in a new one."""
    (tmp_path / "Reacher-v4.attempts.json").touch()
    result, out, err = design_live(serve(reply_with(text)), "--candidates", 1, *options)
    assert (result, out) == (status, "")
    (line,) = [line for line in err.splitlines() if line.startswith("lare-rl: ")]
    assert all(word in line for word in words)
    assert "\x1b" not in err
    name = "talk.json" if "--record" in options else "Reacher-v4.attempts-2.json"
    assert f"every reply is kept in {name}\n" in err
    assert saved_stages(tmp_path / name) == ["candidate", *["correct"] * (n_replies - 1)]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--out", "."], ". is not the name of a file; choose another --out"),
        (["--out", "no/phi.py"], "there is no directory no; choose another --out"),
        (["--record", "./r.json", "--out", "../{here}/r"], "--out writes r.json too"),
        (["--out", "n" * 300], "File name too long"),
        (["--reflect", 1, "--policy", "nowhere"], "nowhere is not a run"),
    ],
)
def test_files_are_checked_before_a_model_is_asked(command, tmp_path, arguments, words):
    options = [str(argument).format(here=tmp_path.name) for argument in arguments]
    status, out, err = command("design", "Reacher-v4", *options)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert words in err


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no directory in which nobody can write")
def test_folder_that_cannot_be_written(serve, design_live, monkeypatch):
    """The replies could not be kept, so none is asked for."""
    server = serve(recorded_answers)
    monkeypatch.chdir("/proc")
    status, out, err = design_live(server)
    assert (status, out, err.count("\n"), server.requests) == (2, "", 1, [])
    assert "Reacher-v4.attempts.json cannot be written" in err


def test_replies_are_printed_if_they_cannot_be_saved(serve, design_live, tmp_path):
    def answer(handler):
        (tmp_path / "Reacher-v4.attempts.json").touch()  # another design was faster
        return reply_with(to_reply(REACHER_PHI))(handler)

    status, out, err = design_live(serve(answer), "--candidates", 1)
    assert (status, "kept" in err) == (2, False)
    assert [exchange.replies for exchange in read_recording(out, "output").exchanges] == [[to_reply(REACHER_PHI)]]
    assert (tmp_path / "Reacher-v4.attempts.json").read_text() == ""


@pytest.mark.parametrize(("is_full", "n_files"), [(True, 1), (False, 0)])
def test_replies_stay_if_the_function_cannot_be_printed(is_full, n_files, serve, design_live, tmp_path, monkeypatch):
    def fail(text):
        raise OSError(errno.ENOSPC, "No space left on device")

    if is_full:
        monkeypatch.setattr(sys.modules["lare_rl.cli.design"], "print_line", fail)
    status, out, err = design_live(serve(reply_with(to_reply(REACHER_PHI))), "--candidates", 1)
    assert (status, out) == ((2, "") if is_full else (0, REACHER_PHI + "\n"))
    assert ("No space left on device" in err) == is_full
    assert len(list(tmp_path.glob("*.attempts.json"))) == n_files


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no disk that is always full")
def test_full_disk():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "lare_rl", "prompt", "Reacher-v4"]
        process = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert process.returncode == 2
    assert process.stderr == "lare-rl: [Errno 28] No space left on device\n"


REPLIES = st.one_of(
    st.text(max_size=200),
    st.binary(max_size=50).map(lambda body: body.decode("latin-1")),
    st.text(max_size=200).map(lambda code: to_reply(code or "?")),
    st.integers(0, len(PHI)).map(lambda length: to_reply(PHI[:length] or "?")),
    st.sampled_from(["", "{}", "null", f"```python\n{PHI}```", to_reply(PHI)]),
)


@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(REPLIES, min_size=1, max_size=3))
def test_design_ends_for_all_replies(replies):
    requests, answers = [], itertools.cycle(replies)

    def answer(messages):
        requests.append(messages)
        return next(answers)

    try:
        function = design(toy_spec(), model=answer, candidates=1)
    except LareError:
        assert len(requests) == 5
    else:
        assert function.size >= 1
        assert len(requests) <= 5

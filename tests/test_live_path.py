"""From a live model to a trained policy: a server on loopback gives the recorded replies."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from helpers.chat_servers import Server, refuse, reply_with, request_messages
from helpers.toy_envs import PHI, toy_spec
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.latent.design import design
from lare_rl.latent.saved import load_function
from lare_rl.llm import prompts
from lare_rl.llm.budget import Budget
from lare_rl.llm.live import LiveModel
from lare_rl.llm.recording import read_recording, shipped_recordings

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


def to_reply(source: str) -> str:
    return json.dumps({"Understand": "", "Analyze": "", "Functions": source})


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


def test_failed_attempts_are_saved(serve, design_live, tmp_path):
    server = serve(reply_with("I would rather talk about something else."))
    for name in ("Reacher-v4.attempts.json", "Reacher-v4.attempts-2.json"):
        status, out, err = design_live(server, "--candidates", 1)
        assert (status, out) == (1, "")
        assert len([line for line in err.splitlines() if line.startswith("lare-rl: ")]) == 1
        assert "not one JSON object" in err
        assert f"every attempt is kept in {name}" in err
        assert saved_stages(tmp_path / name) == ["candidate", *["correct"] * 4]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--requests", 2], "budget of 2 requests"),
        (["--budget", 100], "budget of 100 tokens (0 are used)"),
        (["--minutes", 1e-6], "waiting for the model are over"),
    ],
)
def test_budget(serve, design_live, options, words):
    server = serve(recorded_answers)
    status, out, err = design_live(server, *options)
    assert (status, out) == (2, "")
    assert words in err
    assert len(server.requests) <= 2


def test_replies_are_saved_when_the_budget_ends(serve, design_live, tmp_path):
    status, out, err = design_live(serve(reply_with("\x1b[31mno")), "--candidates", 1, "--requests", 2)
    assert (status, out) == (2, "")
    assert err.splitlines()[-2:-1] == ["every attempt is kept in Reacher-v4.attempts.json"]
    assert "\x1b" not in err
    assert saved_stages(tmp_path / "Reacher-v4.attempts.json") == ["candidate", "correct"]


def test_failed_design_is_one_line(serve, design_live, tmp_path):
    server = serve(reply_with(to_reply("x = np.load('a')\ny = np.fromfile('b')")))
    status, _, err = design_live(server, "--candidates", 1, "--record", "talk.json")
    (line,) = [line for line in err.splitlines() if line.startswith("lare-rl: ")]
    assert status == 1
    assert "'Reacher-v4'" in line
    assert "E-NUMPY line 1" in line
    assert line.endswith(" (and 1 more)")
    assert "every attempt is kept in talk.json" in err
    assert saved_stages(tmp_path / "talk.json") == ["candidate", *["correct"] * 4]


def test_error_of_a_server_is_sanitized(serve, design_live):
    status, _, err = design_live(serve(refuse(401, "\x1b[2J\u202eno\U000e0041")))
    assert status == 2
    assert "HTTP 401: ?[2J?no?" in err.splitlines()[-1]
    assert err.isascii()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--out", "."], ". is not the name of a file; choose another --out"),
        (["--out", "no/phi.py"], "there is no directory no; choose another --out"),
        (["--record", "no/r.json"], "there is no directory no; choose another --record"),
        (["--record", "r.json", "--out", "r.py"], "--out writes r.json too"),
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


def run_lare(*arguments, **streams):
    """Run `lare-rl` in another process."""
    command = [sys.executable, "-c", "from lare_rl.cli import main; main()", *map(str, arguments)]
    return subprocess.run(command, stderr=subprocess.PIPE, **streams)


def test_terminal_without_unicode(tmp_path):
    source = "def evaluation_func(o, a):\n    # größe 漢字 😀\n    return [o[:, :1]]"
    messages = prompts.candidate(read_task("Reacher-v4"))
    exchange = {"stage": "candidate", "messages": messages, "replies": [to_reply(source)]}
    recording = shipped_recordings("factors", 0)[0].model_dump() | {"exchanges": [exchange]}
    (tmp_path / "r.json").write_text(json.dumps(recording))
    arguments = ("design", "Reacher-v4", "--model", "r.json", "--candidates", 1)
    plain = os.environ | {"PYTHONIOENCODING": "cp1252"}
    done = run_lare(*arguments, cwd=tmp_path, env=plain, stdout=subprocess.PIPE)
    assert done.returncode == 0, done.stderr
    assert b"\\u6f22\\u5b57" in done.stdout


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no directory in which nobody can write")
def test_function_is_printed_if_it_cannot_be_written(command, tmp_path):
    status, out, err = command("design", "Reacher-v4", "--out", "/proc/phi.py")
    assert status == 2
    assert "/proc/phi.py cannot be written" in err.splitlines()[-1]
    assert "def evaluation_func" in out
    status, _, err = command("design", "Reacher-v4", "--record", "/proc/talk.json")
    assert status == 2
    assert err.splitlines()[-1] == "every attempt is kept in Reacher-v4.attempts.json"
    assert read_recording((tmp_path / "Reacher-v4.attempts.json").read_text(), "attempts").exchanges


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no disk that is always full")
def test_function_is_saved_if_it_cannot_be_printed(tmp_path):
    with open("/dev/full", "w") as full:
        done = run_lare("design", "Reacher-v4", cwd=tmp_path, stdout=full)
        assert done.returncode == 2
        assert "kept in Reacher-v4.py" in done.stderr.decode().splitlines()[-1]
        assert load_function(tmp_path / "Reacher-v4.py", read_task("Reacher-v4")).size > 0
        done = run_lare("prompt", "Reacher-v4", cwd=tmp_path, stdout=full)
        assert done.returncode == 2
        assert "No space left on device" in done.stderr.decode()


def test_function_of_another_task_is_corrected(serve):
    # The chase has observations of size 2; the recorded function of Reacher reads entry 10.
    reacher = shipped_recordings("factors", 0)
    other = next(recording for recording in reacher if recording.task == "Reacher-v4").exchanges[-1].replies[0]
    server = serve(reply_with(other), reply_with(to_reply(PHI)))
    assert design(toy_spec(), model=LiveModel("m", server.url), candidates=1).source == PHI.strip("\n")
    error = request_messages(server.requests[1])[-1]["content"]
    assert re.search(r"^E-RUN line \d+: IndexError: .* beyond the end of an axis", error, re.MULTILINE)


REPLIES = st.one_of(
    st.text(max_size=200),
    st.binary(max_size=50).map(lambda body: body.decode("latin-1")),
    st.text(max_size=200).map(lambda code: to_reply(code or "?")),
    st.integers(0, len(PHI)).map(lambda length: to_reply(PHI[:length] or "?")),
    st.sampled_from(["", "{}", "null", f"```python\n{PHI}```", to_reply(PHI)]),
)


class RepeatingModel:
    """Gives its replies over and over."""

    name = "repeating"

    def __init__(self, replies):
        self.replies, self.n_requests = replies, 0

    def reply(self, messages, sample):
        self.n_requests += 1
        return self.replies[self.n_requests % len(self.replies)]


@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(REPLIES, min_size=1, max_size=3))
def test_design_ends_for_all_replies(replies):
    model = RepeatingModel(replies)
    try:
        function = design(toy_spec(), model=model, candidates=1)
    except LareError:
        assert model.n_requests == 5
    else:
        assert function.size >= 1
        assert model.n_requests <= 5


def test_long_replies_end_with_the_budget(serve):
    server = serve(reply_with("{" * 2_000_000))
    model = LiveModel("m", server.url, budget=Budget(tokens=100_000), sleep=lambda _: None)
    with pytest.raises(LareError):
        design(toy_spec(), model=model, candidates=1)
    assert len(server.requests) <= 6

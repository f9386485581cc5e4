"""From a live model to a trained policy, without a network: a server on loopback speaks for the recorded model."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from helpers.servers import Server, refuses, says
from helpers.toys import PHI, toy_spec
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.latent.design import design
from lare_rl.latent.saved import load
from lare_rl.llm import prompts
from lare_rl.llm.budget import Budget
from lare_rl.llm.live import LiveModel
from lare_rl.llm.recording import read_recording, shipped_recordings

KEY = "sk-a-key-that-nobody-may-see"


def recorded_answers(handler) -> None:
    """What was recorded for a request, each reply once."""
    asked = handler.server.requests[-1]["messages"]
    for recording in shipped_recordings("factors", 0):
        for exchange in recording.exchanges:
            if exchange.messages == asked:
                times = sum(request["messages"] == asked for request in handler.server.requests)
                return says(exchange.replies[times - 1])(handler)
    return refuses(404, "nobody has asked this before")(handler)


@pytest.fixture
def serve(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    servers = []

    def start(*answers) -> Server:
        servers.append(Server(*answers))
        return servers[-1]

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def everything_written(directory) -> bytes:
    return b"".join(path.read_bytes() for path in directory.rglob("*") if path.is_file())


def test_from_a_live_model_to_a_trained_policy(serve, command, tmp_path):
    server = serve(recorded_answers)
    asked = ("--model", "m", "--base-url", server.url, "--record", "talk.json", "--price", 1, 2)
    status, out, err = command("design", "Reacher-v4", *asked, "--out", "phi.py")
    assert status == 0
    assert out.startswith("wrote phi.py: ")
    assert err.splitlines()[-1] == "m: 6 requests, 600 tokens in, 60 out, 0.0007 by the given prices"
    task = read_task("Reacher-v4")
    live, recorded = load(tmp_path / "phi.py", task), design(task)
    assert (live.source, live.model) == (recorded.source, "m")

    # What was recorded answers again, exactly.
    recording = read_recording((tmp_path / "talk.json").read_text(), "talk.json")
    assert (recording.model, recording.task) == ("m", "Reacher-v4")
    assert [exchange.model_dump() for exchange in recording.exchanges] == list(recorded.exchanges)
    again, out, _ = command("design", "Reacher-v4", "--model", "talk.json")
    assert (again, out) == (0, recorded.source + "\n")
    assert len(server.requests) == 6

    length = "--steps 100 --rollout-steps 50 --evaluate-every 100 --evaluation-episodes 1".split()
    size = "--method lare-linear --td3.warmup 50 --td3.hidden 8 8".split()
    status, _, err = command("train", "Reacher-v4", "--function", "phi.py", "--out", "run", *length, *size)
    assert status == 0
    assert KEY.encode() not in everything_written(tmp_path)


def test_a_recording_is_not_overwritten(serve, command, tmp_path):
    (tmp_path / "talk.json").write_text("mine")
    server = serve(recorded_answers)
    status, _, err = command("design", "Reacher-v4", "--model", "m", "--base-url", server.url, "--record", "talk.json")
    assert status == 2
    assert "lare-rl: talk.json exists, and is not overwritten; choose another --record" in err
    assert (tmp_path / "talk.json").read_text() == "mine"


def test_when_nothing_passes_every_attempt_is_kept(serve, command, tmp_path):
    server = serve(says("I would rather talk about something else."))
    for name in ("Reacher-v4.attempts.json", "Reacher-v4.attempts-2.json"):
        status, out, err = command("design", "Reacher-v4", "--model", "m", "--base-url", server.url, "--candidates", 1)
        assert (status, out) == (1, "")
        assert "none of 5 attempts passed; the last one failed: the reply is not one JSON object" in err
        assert err.count("none of 5 attempts passed") == len(
            [line for line in err.splitlines() if "lare-rl: task" in line]
        )
        assert f"every attempt is kept in {name}" in err
        kept = read_recording((tmp_path / name).read_text(), name)
        assert [exchange.stage for exchange in kept.exchanges] == ["candidate", *["correct"] * 4]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--requests", 2], "lare-rl: the budget of 2 requests is spent"),
        (["--budget", 100], "lare-rl: the next request might exceed the budget of 100 tokens (0 are used)"),
    ],
)
def test_a_budget_ends_a_design(serve, command, arguments, said):
    server = serve(recorded_answers)
    status, out, err = command("design", "Reacher-v4", "--model", "m", "--base-url", server.url, *arguments)
    assert (status, out) == (2, "")
    assert said in err
    assert len(server.requests) <= 2


def test_what_was_said_is_kept_when_the_budget_ends(serve, command, tmp_path):
    server = serve(says("Not today."))
    asked = ("design", "Reacher-v4", "--model", "m", "--base-url", server.url, "--candidates", 1, "--requests", 2)
    status, out, err = command(*asked)
    assert (status, out) == (2, "")
    assert "lare-rl: the budget of 2 requests is spent\nevery attempt is kept in Reacher-v4.attempts.json" in err
    kept = read_recording((tmp_path / "Reacher-v4.attempts.json").read_text(), "kept")
    assert [exchange.stage for exchange in kept.exchanges] == ["candidate", "correct"]


def test_a_design_that_fails_says_so_in_one_line(serve, command):
    wrong = json.dumps({"Understand": "", "Analyze": "", "Functions": "x = np.load('a')\ny = np.fromfile('b')"})
    server = serve(says(wrong))
    status, _, err = command("design", "Reacher-v4", "--model", "m", "--base-url", server.url, "--candidates", 1)
    said = [line for line in err.splitlines() if line.startswith("lare-rl: ")]
    assert status == 1
    start = "lare-rl: task 'Reacher-v4': none of 5 attempts passed; the last one failed: E-NUMPY line 1: np.load"
    assert len(said) == 1
    assert said[0].startswith(start)
    assert said[0].endswith(" (and 1 more)")


def test_a_server_that_fails_does_not_steer_the_terminal(serve, command):
    server = serve(refuses(401, "\x1b[2J\u202eno\U000e0041"))
    status, _, err = command("design", "Reacher-v4", "--model", "m", "--base-url", server.url)
    assert status == 2
    assert err.splitlines()[-1] == "lare-rl: m did not answer: HTTP 401: Error code: 401 - ?[2J?no?"
    assert err.isascii()


def test_the_minutes_of_a_design_are_a_setting(serve, command):
    server = serve(refuses(503))
    asked = ("design", "Reacher-v4", "--model", "m", "--base-url", server.url, "--minutes", 0.02)
    status, _, err = command(*asked)
    assert status == 2
    assert err.startswith("m: waiting for a reply, 1 s at most (1 s are left for all)\n")
    assert "lare-rl: the 1 s of waiting for the model are over (" in err


def test_what_a_model_says_does_not_steer_the_terminal(serve, command):
    server = serve(says('{"Functions": 1, "\x1b]0;gone\x07": 2}'), says("\x1b[31mno"))
    asked = ("design", "Reacher-v4", "--model", "m", "--base-url", server.url, "--candidates", 1, "--requests", 2)
    assert "\x1b" not in command(*asked)[2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--base-url", "http://h/v1"], "--base-url is for a live model: say which one with --model NAME"),
        (
            ["--model", "m", "--draw", 2],
            "--draw chooses a recording, and a live model uses none: leave --draw out",
        ),
        (["--model", "m", "--budget", -5], "budget = -5: at least one is needed"),
        (["--model", "m", "--requests", 0], "requests = 0: at least one is needed"),
        (["--model", "m", "--minutes", 0], "minutes = 0.0: a number above 0 is needed"),
        (["--model", "m", "--temperature", "nan"], "temperature = nan: a number, 0 or more, is needed"),
        (
            ["--temperature", 1],
            "--budget, --requests, --minutes, --price and --temperature are for a live model: say which one with --model NAME",
        ),
        (
            ["--policy", "runs/x"],
            "--policy plays the episodes for --reflect: give --reflect too, with a number of rounds",
        ),
        (["--reflect", -1], "reflect = -1: the number of rounds cannot be negative"),
        (["--out", "."], ". is not the name of a file; choose another --out"),
        (["--out", "no/phi.py"], "no/phi.py cannot be written: there is no directory no; choose another --out"),
        (["--record", "no/r.json"], "no/r.json cannot be written: there is no directory no; choose another --record"),
        (["--record", "r.json", "--out", "r.py"], "--out writes r.json too: choose another --record"),
        (["--record", "./r.json", "--out", "../{here}/r"], "--out writes r.json too: choose another --record"),
        (["--out", "n" * 300], f"{'n' * 300} cannot be written: File name too long"),
        (["--model", "m", "--price", -1, 2], "price = -1.0 2.0: two numbers, 0 or more, are needed"),
        (["--reflect", 1, "--policy", "nowhere"], "nowhere is not a run: there is no config.json in it"),
    ],
)
def test_options_of_a_design_that_make_no_sense(command, tmp_path, arguments, message):
    """Before anybody is asked, or paid."""
    given = [str(argument).format(here=tmp_path.name) for argument in arguments]
    assert command("design", "Reacher-v4", *given) == (2, "", f"lare-rl: {message}\n")


def run_lare(*arguments, **streams):
    """`lare-rl` in a process of its own."""
    command = [sys.executable, "-c", "from lare_rl.cli import main; main()", *map(str, arguments)]
    return subprocess.run(command, stderr=subprocess.PIPE, **streams)


def test_a_terminal_that_cannot_show_a_letter(tmp_path):
    """No reason to lose a function."""
    source = "def evaluation_func(o, a):\n    # größe 漢字 😀\n    return [o[:, :1]]"
    recording = shipped_recordings("factors", 0)[0].model_dump()
    recording["exchanges"] = [
        {
            "stage": "candidate",
            "messages": prompts.candidate(read_task("Reacher-v4")),
            "replies": [json.dumps({"Understand": "", "Analyze": "", "Functions": source})],
        }
    ]
    (tmp_path / "r.json").write_text(json.dumps(recording))
    asked = ("design", "Reacher-v4", "--model", "r.json", "--candidates", 1)
    plain = os.environ | {"PYTHONIOENCODING": "cp1252"}
    done = run_lare(*asked, cwd=tmp_path, env=plain, stdout=subprocess.PIPE)
    assert done.returncode == 0, done.stderr
    assert b"\\u6f22\\u5b57" in done.stdout


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no directory in which nobody can write")
def test_what_was_paid_for_is_shown_where_nothing_can_be_written(command, tmp_path):
    status, out, err = command("design", "Reacher-v4", "--out", "/proc/phi.py")
    assert (status, err.splitlines()[-1]) == (2, "lare-rl: /proc/phi.py cannot be written: No such file or directory")
    assert "def evaluation_func" in out
    status, _, err = command("design", "Reacher-v4", "--record", "/proc/talk.json")
    assert status == 2
    assert err.splitlines()[-1] == "every attempt is kept in Reacher-v4.attempts.json"
    assert read_recording((tmp_path / "Reacher-v4.attempts.json").read_text(), "kept").exchanges


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no disk that is always full")
def test_what_was_paid_for_is_kept_where_nothing_can_be_printed(tmp_path):
    with open("/dev/full", "w") as full:
        done = run_lare("design", "Reacher-v4", cwd=tmp_path, stdout=full)
        assert done.returncode == 2
        said = done.stderr.decode().splitlines()[-1]
        assert (
            said == "lare-rl: nothing can be printed (No space left on device); the function is kept in Reacher-v4.py"
        )
        assert load(tmp_path / "Reacher-v4.py", read_task("Reacher-v4")).size > 0
        done = run_lare("prompt", "Reacher-v4", cwd=tmp_path, stdout=full)
        assert (done.returncode, done.stderr.decode()) == (2, "lare-rl: [Errno 28] No space left on device\n")


def test_a_reply_for_another_task_is_corrected(serve):
    # The chase has observations of size 2; the recorded function of Reacher reads entry 10.
    reacher = shipped_recordings("factors", 0)
    other = next(one for one in reacher if one.task == "Reacher-v4").exchanges[-1].replies[0]
    good = json.dumps({"Understand": "", "Analyze": "", "Functions": PHI})
    server = serve(says(other), says(good))
    assert design(toy_spec(), model=LiveModel("m", server.url), candidates=1).source == PHI.strip("\n")
    error = server.requests[1]["messages"][-1]["content"]
    assert re.search(r"^E-RUN line \d+: IndexError: .* beyond the end of an axis", error, re.MULTILINE)


REPLIES = st.one_of(
    st.text(max_size=200),
    st.binary(max_size=50).map(lambda body: body.decode("latin-1")),
    st.text(max_size=200).map(lambda code: json.dumps({"Understand": "", "Analyze": "", "Functions": code or "?"})),
    st.integers(0, len(PHI)).map(
        lambda cut: json.dumps({"Understand": "", "Analyze": "", "Functions": PHI[:cut] or "?"})
    ),
    st.sampled_from(
        [
            "",
            "{}",
            "null",
            "```python\ndef evaluation_func(observation, action):\n    return [action]\n```",
            json.dumps({"Understand": "", "Analyze": "", "Functions": PHI}),
        ]
    ),
)


class Says:
    """A model that says whatever it is given, over and over."""

    name = "says"

    def __init__(self, replies):
        self.replies, self.asked = replies, 0

    def reply(self, messages, sample):
        self.asked += 1
        return self.replies[self.asked % len(self.replies)]


@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(REPLIES, min_size=1, max_size=3))
def test_whatever_comes_back_the_loop_ends(replies):
    model = Says(replies)
    try:
        function = design(toy_spec(), model=model, candidates=1)
    except LareError:
        assert model.asked == 5
    else:
        assert function.size >= 1
        assert model.asked <= 5


def test_a_flood_of_text_ends_within_the_budget(serve):
    server = serve(says("{" * 2_000_000))
    model = LiveModel("m", server.url, budget=Budget(tokens=100_000), sleep=lambda _: None)
    with pytest.raises(LareError):
        design(toy_spec(), model=model, candidates=1)
    assert len(server.requests) <= 6

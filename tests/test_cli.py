"""The command line, in this process: what it prints, and that a mistake is one line and exit status 2."""

import json
import re
import shutil
from pathlib import Path

import pytest

from helpers.toy_envs import PHI
from lare_rl import cli
from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.credit.methods import METHODS
from lare_rl.envs.load import read_task, shipped_tasks
from lare_rl.llm.prompts import candidate
from lare_rl.util.provenance import code_version

TINY = (
    "--steps 200 --rollout-steps 50 --evaluate-every 100 --evaluation-episodes 1 "
    "--method lare-linear --td3.warmup 100 --td3.hidden 8 8"
).split()


@pytest.fixture
def phi(tmp_path):
    (tmp_path / "phi.py").write_text(PHI)
    return tmp_path / "phi.py"


def first_column(table):
    return [line.split()[0] for line in table.splitlines()[1:] if not line.startswith(" ")]


# --- arguments -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ("train Task --steps 1e5", ["'1e5'", "whole number"]),
        ("train Task --step 9", ["--step, 9", "'--steps'"]),
        ("train Task --td3.gama 9", ["--td3.gama", "'--td3.gamma'"]),
        ("train Task --td3.gamma high", ["'high'", "number"]),
        ("train Task --td3.gamma 3", ["td3.gamma = 3.0"]),
        ("train Task --credit.steps 0", ["credit.steps = 0"]),
        ("train Task --judges left", ["'left'", "before, after, both"]),
        ("train Task --algorithm dqn", ["'dqn'", *ALGORITHMS]),
        ("train Task --seeds", ["--seeds"]),
        ("", ["--help"]),
        ("trian", ["'trian'", "'train'"]),
        ("evaluate a b", ["b", "lare-rl evaluate --help"]),
        ("evaluate a --seed 3", ["--seed, 3"]),
        ("evaluate", ["RUN"]),
        ("export a", ["--out DIR"]),
        ("design Task --price 1", ["--price"]),
        ("compare", ["run"]),
        ("report", ["run"]),
    ],
)
def test_parse_mistake(arguments, parts, command):
    status, out, err = command(*arguments.split())
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert all(part in err for part in ["lare-rl: ", *parts])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("train", ["lare-rl train TASK", "--resume DIR"]),
        ("train --resume runs/none", ["runs/none is not a run"]),
        ("train Reacher-v4 --resume runs/none", ["--resume", "--steps"]),
        ("train --resume runs/none --seed 1", ["--resume", "--steps"]),
        ("train Reacher-v4 --function none.py", ["none.py does not exist"]),
        ("train Reacher-v4 --steps 120", ["steps = 120", "rollout_steps = 50"]),
        ("train Reacher-v4 --seed -1", ["seed = -1"]),
        ("train Reacher-v4 --seed 2147483647 --seeds 2", ["seeds = 2", "2147483647"]),
        ("train Reacher-v4 --method magic", ["'magic'", *METHODS]),
        ("train CN-6 --algorithm ppo", ["ppo", "CN-6"]),
        ("train CN-6 --capacity 50", ["capacity = 50"]),
        ("train CN-6 --ippo.hidden -1", ["hidden.0 = -1"]),
        ("train CompetitivePP-6-prey", ["CompetitivePP-6-prey is one team"]),
        ("train CompetitivePP-6 --function phi.py", ["CompetitivePP-6-predator, CompetitivePP-6-prey", "1 were given"]),
        ("train CN-6 --method dense --credit.sum-form True", ["credit.sum_form", "dense"]),
        ("train CN-6 --ppo.clip 0.1", ["ppo.clip", "ippo.clip"]),
        ("train Reacher-v4 --method dense --judges both", ["judges", "dense"]),
        ("train HalfCheetah-v4 --fit-every 2", ["fit_every", "lare-bayes"]),
        ("train Reacher-v4 --draw 1 --function phi.py", ["draw", "function"]),
        ("prompt Reacher", ["'Reacher-v4'", *shipped_tasks()]),
        ("prompt CompetitivePP-6", ["CompetitivePP-6-predator, CompetitivePP-6-prey"]),
        ("verify none.py --task Reacher-v4", ["none.py does not exist"]),
        ("design CompetitivePP-6", ["CompetitivePP-6-predator, CompetitivePP-6-prey"]),
        ("design Reacher-v4 --draw 7", ["draw 7", "0, 1, 2, 3, 4"]),
        ("design Reacher-v4 --draw 1 --model m", ["--draw"]),
        ("design Reacher-v4 --base-url http://x", ["--base-url", "--model"]),
        ("design Reacher-v4 --budget 9", ["--budget", "--model"]),
        ("design Reacher-v4 --model m --budget 0", ["budget = 0"]),
        ("design Reacher-v4 --model m --minutes nan", ["minutes = nan"]),
        ("design Reacher-v4 --model m --price 1 -1", ["price"]),
        ("design Reacher-v4 --model m --temperature -1", ["temperature = -1"]),
        ("design Reacher-v4 --policy run", ["--policy", "--reflect"]),
        ("design Reacher-v4 --reflect -1", ["reflect = -1"]),
        ("design Reacher-v4 --reflect 1 --data log", ["--reflect", "--data"]),
        ("cross-play . runs/none", [". is not a run"]),
        ("evaluate .", [". is not a run"]),
        ("report", ["run"]),
        ("report one two", ["one is not a run"]),
    ],
)
def test_mistake_is_one_line_and_status_2(command, tmp_path, arguments, words):
    status, out, err = command(*arguments.split())
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert all(word in err for word in ["lare-rl: ", *words])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [["--debug", "evaluate", "none"], ["evaluate", "none", "--debug"]])
def test_debug(command, arguments):
    status, out, err = command(*arguments)
    assert (status, out) == (2, "")
    assert err.startswith("Traceback (most recent call last):\n")
    assert err.splitlines()[-1].startswith("lare-rl: none is not a run")


def test_version(command):
    assert command("--version") == (0, f"{code_version()}\n", "")


def test_help_names_every_command(command):
    status, out, _ = command("--help")
    assert status == 0
    assert all(name in out for name in cli.COMMANDS)


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_of_a_command(name, command):
    status, out, _ = command(name, "--help")
    assert status == 0
    assert "None" not in out
    assert "(default: )" not in out


def test_help_of_options(command):
    _, out, _ = command("train", "--help")
    for option in (
        "--steps INT",
        "--out DIR",
        "--judges {before,after,both}",
        "--credit.hidden [INT [INT ...]]",
        "--td3.gamma FLOAT",
    ):
        assert f" {option} " in out
    # Lines of a docstring are joined: these two begin a line in the source.
    lines = [line.strip(" |│") for line in out.splitlines()]
    assert "one --function for each, in the order of the task. (repeatable)" not in lines
    assert "qmix if there are a global state and action masks, else ippo." not in lines


# --- lists, prompt, new-task -----------------------------------------------------------------------------------------


def test_tasks(command):
    status, out, err = command("tasks")
    assert (status, err) == (0, "")
    head, *rows = [line.split() for line in out.splitlines()]
    assert head == ["task", "observation", "action", "judges", "agents"]
    assert [row[0] for row in rows] == shipped_tasks()
    assert ["Reacher-v4", "11", "2", "before", "one"] in rows
    assert ["CN-30", "26", "5", "after", "many"] in rows
    assert ["CompetitivePP-6-prey", "24", "5", "after", "of", "one", "team"] in rows


@pytest.mark.parametrize(("name", "registered"), [("methods", METHODS), ("algorithms", ALGORITHMS)])
def test_methods_and_algorithms(command, name, registered):
    status, out, err = command(name)
    assert (status, err) == (0, "")
    assert first_column(out) == list(registered)


@pytest.mark.parametrize("kind", ["factors", "reward"])
def test_prompt(command, kind):
    system, user = candidate(read_task("Reacher-v4"), kind)
    text = f"--- system ---\n{system['content']}\n\n--- user ---\n{user['content']}\n\n"
    assert command("prompt", "Reacher-v4", "--kind", kind) == (0, text, "")


def test_new_task(command, tmp_path):
    status, out, err = command("new-task", "Pendulum-v1")
    assert (status, err) == (0, "")
    assert out.splitlines()[0] == "wrote Pendulum-v1.toml"
    content = (tmp_path / "Pendulum-v1.toml").read_bytes()
    status, out, err = command("new-task", "Pendulum-v1")
    assert (status, out) == (2, "")
    assert "not overwritten; choose another --out" in err
    assert (tmp_path / "Pendulum-v1.toml").read_bytes() == content
    status, out, _ = command("prompt", "Pendulum-v1.toml")
    assert status == 0
    assert "# Task\nThe inverted pendulum swingup problem" in out


def test_new_task_of_two_teams(command, tmp_path):
    status, out, err = command("new-task", "pettingzoo/mpe2.simple_adversary_v3:parallel_env")
    assert (status, err) == (0, "")
    files = [f"simple_adversary_v3{team}.toml" for team in ("", "-adversary", "-agent")]
    first, heading, sentence, *_ = out.splitlines()
    assert first == f"wrote {', '.join(files)}"
    assert "rewards" in heading
    assert "reward" in sentence
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(files)


def test_new_task_without_documentation(command):
    status, out, _ = command("new-task", "Hopper-v4", "--out", "hopper.toml")
    assert status == 0
    missing = re.findall(r"fill in: (\w+) ", out)
    assert missing == ["description", "observation", "action"]


# --- design, verify --------------------------------------------------------------------------------------------------


def test_design(command):
    status, out, err = command("design", "Reacher-v4", "--kind", "reward")
    assert (status, err) == (0, "".join(f"candidate {n}: passes\n" for n in range(1, 6)) + "attempt 1: passes\n")
    assert "def evaluation_func(observation, action):\n" in out
    status, out, err = command("design", "Reacher-v4", "--candidates", 1, "--no-pre-verification")
    assert (status, err) == (0, "")
    assert "def evaluation_func" in out


def test_design_to_a_file(command, tmp_path):
    status, out, _ = command("design", "Reacher-v4", "--out", "phi.py")
    assert status == 0
    assert out.startswith("wrote phi.py: ")
    content = {name: (tmp_path / name).read_bytes() for name in ("phi.py", "phi.json")}
    status, out, err = command("design", "Reacher-v4", "--draw", 1, "--out", "phi")
    assert (status, out) == (2, "")
    assert "phi.py exists" in err
    assert {name: (tmp_path / name).read_bytes() for name in content} == content


def test_verify(command, phi, spec_file):
    status, out, err = command("verify", phi, "--task", spec_file())
    assert (status, err) == (0, "")
    assert out.splitlines() == [
        "for Chase: observations of 2 numbers, actions of 1",
        "passed  read",
        "passed  finite",
        "factor  f_near reads observation[0], action[0]",
        "factor  f_effort reads action[0]",
    ]


def test_verify_with_returns(command, phi, spec_file):
    status, out, err = command("verify", phi, "--task", spec_file(), "--fit", "30")
    assert (status, err) == (0, "playing 30 episodes by random actions\n")
    r2 = re.search(r"R² = (\d\.\d+) .*standard error of (less than )?0\.0", out)
    assert r2
    assert float(r2[1]) > 0.9
    assert "\nFitted to all 30 episodes" in out
    assert "(before)" not in out
    _, both, _ = command("verify", phi, "--task", spec_file(), "--fit", "30", "--judges", "both")
    assert "before" in both.partition("Fitted to all 30 episodes")[2]


@pytest.mark.parametrize(
    ("options", "words"), [(["--fit", "10"], "at least 20 episodes"), (["--policy", "run"], "--policy")]
)
def test_verify_with_too_few_returns(command, phi, spec_file, options, words):
    status, out, err = command("verify", phi, "--task", spec_file(), *options)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert words in err


def test_verify_prints_every_error(command, spec_file, tmp_path):
    (tmp_path / "bad.py").write_text("import os\ndef evaluation_func(o, a):\n    return [np.clamp(a), open('x')]\n")
    status, out, err = command("verify", "bad.py", "--task", spec_file())
    assert (status, err) == (1, "")
    _, failed, *errors = out.splitlines()
    assert failed == "FAILED  read"
    assert [error.split(":")[0] for error in errors] == ["        E-IMPORT line 1", "        E-NUMPY line 3"]
    assert "np.clip" in errors[1]


def test_verify_reply_of_a_chat(command, spec_file, tmp_path):
    source = "def evaluation_func(o, a):\n    return [a[:, 0]]"
    (tmp_path / "reply.json").write_text(json.dumps({"Understand": "", "Analyze": "", "Functions": source}))
    status, out, err = command("verify", "reply.json", "--task", spec_file())
    assert (status, err) == (1, "")
    assert "        E-FORM line 2" in out
    assert "into the same chat" in out.splitlines()[-1]


def test_verify_gives_advice(command, spec_file, tmp_path):
    (tmp_path / "dull.py").write_text("def evaluation_func(o, a):\n    still = 0 * a\n    return [still, a]\n")
    status, out, _ = command("verify", "dull.py", "--task", spec_file())
    assert status == 0
    assert "advice  factor 'still' never varies" in out


# --- runs ------------------------------------------------------------------------------------------------------------


def test_error_of_many_lines(command, spec_file, tmp_path):
    (tmp_path / "bad.py").write_text("import os\ndef evaluation_func(o, a):\n    return [np.load(a)]\n")
    status, _, err = command("train", spec_file(), "--function", "bad.py")
    assert (status, err.count("\n")) == (2, 1)
    assert "bad.py: " in err
    assert "E-IMPORT line 1" in err
    assert "E-NUMPY line 3" in err


def test_from_training_to_report(command, spec_file, phi):
    run = Path("runs/Chase-lare-linear-td3-s0")
    status, out, _ = command("train", spec_file(), *TINY, "--function", phi)
    assert status == 0
    assert out.endswith(f"finished {run}; to see it: lare-rl report {run}\n")
    metrics = (run / "metrics.jsonl").read_bytes()
    assert metrics.count(b"\n") == 2

    status, out, err = command("evaluate", run, "--episodes", 2)
    assert (status, err) == (0, "")
    policy, random, difference = out.splitlines()
    assert re.fullmatch(r"seed 0: return -\S+ ± \S+ over 2 episodes", policy)
    assert re.fullmatch(r"random actions: return -\S+ ± \S+ over 10 episodes", random)
    assert re.fullmatch(r"difference: \S+ ± \S+ \(± is its standard error\)", difference)
    _, out, _ = command("evaluate", run, "--episodes", 2, "--best")
    assert re.match(r"seed 0: return -\S+ ± \S+ over 2 episodes \(the policy of step ([12])00", out)
    assert ("before its first update" in out) == ("step 100" in out)

    assert command("report", run)[:2] == (0, f"wrote {run / 'report.html'}\n")
    assert "f_near" in (run / "report.html").read_text(encoding="utf-8")
    assert command("report", run, run, "--out", "both.html")[:2] == (0, "wrote both.html\n")
    status, out, err = command("evaluate", run, "--video", "film.avi")
    assert (status, out) == (2, "")
    assert "film.avi" in err

    # A finished run is not trained again. A page that was watched is updated.
    (run / "watch.html").write_text("stale")
    status, out, _ = command("train", "--resume", run)
    assert status == 0
    assert "Step 200 of 200; not running" in (run / "watch.html").read_text(encoding="utf-8")
    assert out.endswith(f"finished {run}; to see it: lare-rl report {run}\n")
    assert (run / "metrics.jsonl").read_bytes() == metrics

    status, out, err = command("train", spec_file(), *TINY, "--function", phi, "--out", run)
    assert (status, out) == (2, "")
    assert f"{run} exists" in err
    assert (run / "metrics.jsonl").read_bytes() == metrics

    # The report needs no checkpoint.
    shutil.rmtree(run / "checkpoint")
    assert command("report", run, "--out", "without.html")[:2] == (0, "wrote without.html\n")
    assert "checkpoint" in Path("without.html").read_text(encoding="utf-8")

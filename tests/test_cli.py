import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.scripted_model import to_reply
from helpers.toy_envs import PHI
from lare_rl import cli
from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.cli.terminal import print_progress
from lare_rl.credit.methods import METHODS
from lare_rl.envs.load import read_task, shipped_tasks
from lare_rl.llm.prompts import candidate
from lare_rl.util.provenance import code_version

TINY = (
    "--steps 200 --rollout-steps 50 --evaluate-every 100 --evaluation-episodes 1 "
    "--method lare-linear --credit.score sum --td3.warmup 100 --td3.hidden 8 8 --td3.batch-size 8"
).split()


@pytest.fixture
def phi(tmp_path):
    (tmp_path / "phi.py").write_text(PHI)
    return tmp_path / "phi.py"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("train Task --steps 1e5", ["--steps: '1e5'", "whole number"]),
        ("train Task --steps 9 --td3.hidden 8 8,9", ["--td3.hidden: '8,9'", "whole number"]),
        ("train Task --ppo.no-aneal", ["'--ppo.no-anneal'"]),
        ("train Task --td3 3", ["--td3, 3", "'--td3."]),
        ("train Task --td3.gamma high", ["--td3.gamma: 'high'", "number"]),
        ("train Task --scored-observation=left", ["--scored-observation: 'left'", "before, after, both"]),
        ("", ["--help"]),
        ("trian", ["'trian'", "'train'"]),
        ("evaluate a b", ["b", "lare-rl evaluate --help"]),
        ("train Reacher-v4 --credit.no-start-value", ["write --credit.start-value False"]),
        ("evaluate a --seed 3", ["--seed, 3"]),
        ("train", ["lare-rl train TASK", "--resume DIR"]),
        ("train Reacher-v4 --method magic", ["'magic'", *METHODS]),
        ("train CN-6 --ppo.clip 0.1", ["ppo.clip", "ippo.clip"]),
        ("prompt Reacher", ["'Reacher-v5'", *shipped_tasks()]),
        ("prompt CompetitivePP-6", ["CompetitivePP-6-predator, CompetitivePP-6-prey"]),
        ("verify none.py --task Reacher-v4", ["none.py does not exist"]),
        ("design Reacher-v4 --draw 7", ["draw 7", "0, 1, 2, 3, 4"]),
        ("design Reacher-v4 --draw 1 --model m.json", ["--draw"]),
        ("design Reacher-v4 --budget 9", ["--budget", "--model"]),
        ("design Reacher-v4 --model m --budget 0", ["budget = 0"]),
        ("design Reacher-v4 --policy run", ["--policy", "--reflect"]),
        ("cross-play . runs/none", [". is not a run"]),
        ("report one two", ["one is not a run"]),
    ],
)
def test_command_mistake(command, tmp_path, arguments, words):
    status, out, err = command(*arguments.split())
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert all(word in err for word in ["lare-rl: ", *words])
    assert list(tmp_path.iterdir()) == []


def test_debug_and_version(command):
    for arguments in ("--debug evaluate none", "evaluate none --debug"):
        status, out, err = command(*arguments.split())
        assert (status, out) == (2, "")
        assert err.startswith("Traceback (most recent call last):\n")
        assert err.splitlines()[-1].startswith("lare-rl: none is not a run")
    assert command("--version") == (0, f"{code_version()}\n", "")


def test_help(command):
    overview = command("--help")[1]
    assert all(name in overview for name in cli.COMMANDS)
    assert "--fit" not in overview  # each command in a sentence or two
    for name in cli.COMMANDS:
        status, out, _ = command(name, "--help")
        assert (status, "None" in out, "(default: )" in out) == (0, False, False), name


def test_help_of_options(command):
    _, out, _ = command("train", "--help")
    options = ["steps INT", "out DIR", "scored-observation {before,after,both}", "credit.hidden [INT [INT ...]]"]
    assert all(f" --{option} " in out for option in options)
    assert not any(f" --{name}." in out for name in ALGORITHMS)
    for name in ("--algorithm sac", "--algorithm=sac"):
        _, longer, _ = command("train", *name.split(), "--help")
        assert " --sac.gamma FLOAT " in longer
        assert " --td3." not in longer
    # Lines of a docstring are joined.
    lines = {line.strip() for line in cli.train.__doc__.partition("Args:")[2].splitlines()} - {""}
    assert lines.isdisjoint(line.strip(" |│") for line in out.splitlines())


def test_a_typo_in_a_task_file_is_reported_before_slow_imports(spec_file):
    path = str(spec_file(observation=None, observatoin="typo"))
    program = f"""
import sys
from lare_rl.cli import main
for arguments in ["train", {path!r}], ["verify", "phi.py", "--task", {path!r}]:
    sys.argv = ["lare-rl", *arguments]
    try:
        main()
    except SystemExit:
        print(sorted({{"jax", "gymnasium", "numpy"}} & set(sys.modules)))
"""
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert process.stderr.count("there is no key 'observatoin'") == 2
    assert process.stdout == "[]\n[]\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no disk that is always full")
def test_progress_on_a_full_disk(monkeypatch):
    with open("/dev/full", "w", buffering=1) as full:
        monkeypatch.setattr(sys, "stderr", full)
        print_progress("half done")


def test_tasks(command):
    status, out, err = command("tasks")
    assert (status, err) == (0, "")
    head, *rows = [line.split() for line in out.splitlines()]
    assert head == ["task", "observation", "action", "scored_observation", "agents"]
    assert [row[0] for row in rows] == shipped_tasks()
    assert ["Reacher-v4", "11", "2", "before", "one"] in rows
    assert ["CN-30", "26", "5", "after", "many"] in rows
    assert ["CompetitivePP-6-prey", "24", "5", "after", "of", "one", "team"] in rows


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
    assert "choose another --out" in err
    assert (tmp_path / "Pendulum-v1.toml").read_bytes() == content
    assert "# Task\nThe inverted pendulum swingup problem" in command("prompt", "Pendulum-v1.toml")[1]


def test_new_task_of_two_teams(command, tmp_path):
    status, out, err = command("new-task", "pettingzoo/mpe2.simple_adversary_v3:parallel_env")
    assert (status, err) == (0, "")
    files = [f"simple_adversary_v3{team}.toml" for team in ("", "-adversary", "-agent")]
    assert out.splitlines()[:2] == [f"wrote {', '.join(files)}", "  its first lines say what was left out, if anything"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(files)
    for name in files[1:]:
        assert f"lare-rl design {name} --model NAME" in out
    (prompted,) = re.findall(r"lare-rl prompt (\S+)", out)
    assert command("prompt", prompted)[0] == 0
    assert "teams lists them" in command("prompt", "CompetitivePP-6")[2]
    (tmp_path / files[0]).unlink()
    for options, words in (((), "choose another folder"), (("--out", files[2]), "of a team")):
        assert words in command("new-task", "pettingzoo/mpe2.simple_adversary_v3:parallel_env", *options)[2]
        assert sorted(path.name for path in tmp_path.iterdir()) == files[1:]


def test_design(command, tmp_path):
    status, out, err = command("design", "Reacher-v4", "--kind", "reward")
    assert (status, err) == (0, "".join(f"candidate {n}: passes\n" for n in range(1, 6)) + "attempt 1: passes\n")
    assert "def evaluation_func(observation, action):\n" in out
    assert command("design", "Reacher-v4", "--candidates", 1, "--no-pre-verification", "--out", "phi.py")[0] == 0
    content = {name: (tmp_path / name).read_bytes() for name in ("phi.py", "phi.json")}
    status, out, err = command("design", "Reacher-v4", "--draw", 1, "--out", "phi")
    assert (status, out) == (2, "")
    assert "phi.py exists" in err
    assert "--function 'my phi.py'" in command("design", "Reacher-v4", "--candidates", 1, "--out", "my phi.py")[1]
    assert {name: (tmp_path / name).read_bytes() for name in content} == content
    assert "wrote phi.v2.py: " in command("design", "Reacher-v4", "--candidates", 1, "--out", "phi.v2")[1]
    (tmp_path / "phi.json").unlink()
    assert command("design", "Reacher-v4", "--out", "phi.py")[:2] == (2, "")  # not even printed


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


@pytest.mark.long
def test_verify_with_returns(command, phi, spec_file):
    status, out, err = command("verify", phi, "--task", spec_file(), "--fit", "30")
    assert (status, err) == (0, "playing 30 episodes by random actions\n")
    r2 = re.search(r"R² = (\d\.\d+) .*standard error of (less than )?0\.0", out)
    assert r2
    assert float(r2[1]) > 0.9
    assert "pays at 20 of 20 steps" in out
    assert "Play more episodes" not in out
    assert "\nFitted to all 30 episodes" in out
    assert "(before)" not in out
    _, both, _ = command("verify", phi, "--task", spec_file(), "--fit", "30", "--scored-observation", "both")
    assert "before" in both.partition("Fitted to all 30 episodes")[2]
    levels = spec_file(environment="toys/Levels-v0", group="level")
    _, grouped, _ = command("verify", phi, "--task", levels, "--fit", "30")
    assert "by the groups alone" in grouped
    _, wrong, _ = command("verify", phi, "--task", spec_file(scored_observation="after"), "--fit", "30")
    assert "--scored-observation before explains more" in wrong


SAVED_REPLY = to_reply("def evaluation_func(o, a):\n    return [a[:, 0]]")
BAD_SOURCE = "import os\ndef evaluation_func(o, a):\n    return [np.clamp(a), open('x')]\n"
DULL_SOURCE = "def evaluation_func(o, a):\n    still = 0 * a\n    return [still, a]\n"


@pytest.mark.parametrize(
    ("file", "text", "options", "status", "words"),
    [
        ("phi.py", PHI, "--fit 19", 2, ["at least 20 episodes"]),
        ("phi.py", PHI, "--policy run", 2, ["--policy"]),
        ("bad.py", BAD_SOURCE, "", 1, ["FAILED  read\n        E-IMPORT line 1:", "        E-NUMPY line 3:", "np.clip"]),
        ("reply.json", SAVED_REPLY, "", 1, ["        E-FORM line 2", "into the same chat"]),
        ("dull.py", DULL_SOURCE, "", 0, ["advice  factor 'still' never varies"]),
    ],
)
def test_verify_messages(file, text, options, status, words, command, spec_file, tmp_path):
    (tmp_path / file).write_text(text)
    result, out, err = command("verify", file, "--task", spec_file(), *options.split())
    assert result == status
    assert (out if status == 2 else err) == ""
    assert all(word in out + err for word in words)


def test_error_of_many_lines(command, spec_file, tmp_path):
    (tmp_path / "bad.py").write_text(BAD_SOURCE)
    status, _, err = command("train", spec_file(), "--function", "bad.py")
    assert (status, err.count("\n")) == (2, 1)
    assert all(words in err for words in ("bad.py: ", "E-IMPORT line 1", "E-NUMPY line 3"))


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
    status, out, err = command("evaluate", run, "--video", "film.avi")
    assert (status, out) == (2, "")
    assert "film.avi" in err

    # A finished run is not trained again.
    status, out, _ = command("train", "--resume", run)
    assert status == 0
    assert out.endswith(f"finished {run}; to see it: lare-rl report {run}\n")
    assert (run / "metrics.jsonl").read_bytes() == metrics

    status, out, err = command("train", spec_file(), *TINY, "--function", phi, "--out", run)
    assert (status, out) == (2, "")
    assert f"{run} exists" in err
    assert (run / "metrics.jsonl").read_bytes() == metrics

    # The report is of several runs, and needs no checkpoint.
    shutil.rmtree(run / "checkpoint")
    assert command("report", run, run, "--out", "both.html")[:2] == (0, "wrote both.html\n")
    assert "Without a checkpoint" in Path("both.html").read_text(encoding="utf-8")

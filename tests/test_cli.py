"""The command line, in this process: what it prints, and that a mistake is one line and exit status 2."""

import json
import re
import shutil
from pathlib import Path

import pytest

from helpers.toys import PHI
from lare_rl import cli
from lare_rl.algorithms.table import ALGORITHMS
from lare_rl.cli.runs import when_saved
from lare_rl.credit.methods import METHODS
from lare_rl.envs.load import read_task, shipped_tasks
from lare_rl.llm.prompts import candidate
from lare_rl.util.provenance import source

DRAWING = "drawing, which takes up to a minute for each run\n"
TINY = (
    "--steps 200 --rollout-steps 50 --evaluate-every 100 --evaluation-episodes 1 "
    "--method lare-linear --td3.warmup 100 --td3.hidden 8 8"
).split()


@pytest.fixture
def phi(tmp_path):
    (tmp_path / "phi.py").write_text(PHI)
    return tmp_path / "phi.py"


def test_tasks_are_listed(command):
    status, out, err = command("tasks")
    assert (status, err) == (0, "")
    head, *rows = [line.split() for line in out.splitlines()]
    assert head == ["task", "observation", "action", "judges", "agents"]
    assert [row[0] for row in rows] == shipped_tasks()
    assert ["Reacher-v4", "11", "2", "before", "one"] in rows
    assert ["CN-30", "26", "5", "after", "many"] in rows
    assert ["CompetitivePP-6-prey", "24", "5", "after", "of", "one", "team"] in rows


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("train Task --steps 1e5", "--steps 1e5: not a whole number, such as 10000; see lare-rl train --help"),
        ("train Task --step 9", "unrecognized options: --step, 9 (did you mean '--steps'?); see lare-rl train --help"),
        ("trian", "there is no command 'trian' (did you mean 'train'?); see lare-rl --help"),
        ("check task.toml", "there is no command 'check'; see lare-rl --help"),
        ("evaluate a b", "unrecognized options: b; see lare-rl evaluate --help"),
        ("evaluate a --seed 3", "unrecognized options: --seed, 3; see lare-rl evaluate --help"),
        ("evaluate", "lare-rl evaluate needs RUN (a run directory); see lare-rl evaluate --help"),
        ("design Task --price 1", "--price 1: not of the kind {FLOAT FLOAT}; see lare-rl design --help"),
        ("train Task --seeds", "--seeds needs a value; see lare-rl train --help"),
        (
            "export a",
            "lare-rl export needs --out DIR (the directory to write, which must not exist); see lare-rl export --help",
        ),
        (
            "train Task --td3.gamma high",
            "Error parsing --td3.gamma: could not convert string to float: 'high'; see lare-rl train --help",
        ),
        ("compare", "say which runs: no run is given"),
        ("report", "say which runs: no run is given"),
    ],
)
def test_a_mistake_on_the_command_line_is_one_line(arguments, line, command):
    assert command(*arguments.split()) == (2, "", f"lare-rl: {line}\n")


def test_an_unknown_choice_lists_those_there_are(command):
    status, _, err = command("train", "Task", "--algorithm", "dqn")
    known = ", ".join(sorted(ALGORITHMS))
    assert (status, err) == (2, f"lare-rl: --algorithm dqn: not one of {known}; see lare-rl train --help\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            "CN-6 --method dense --credit.sum-form True",
            "credit.sum_form makes no difference to dense: leave the setting out",
        ),
        (
            "CN-6 --ppo.clip 0.1",
            "ppo.clip makes no difference to ippo on CN-6; it has ippo.clip: leave the setting out",
        ),
        ("Reacher-v4 --method dense --judges both", "judges makes no difference to dense: leave the setting out"),
        ("CN-6 --scale-rewards", "scale_rewards makes no difference to ippo on CN-6: leave the setting out"),
        ("CN-6 --method dense --capacity 1000", "capacity makes no difference to dense: leave the setting out"),
        ("HalfCheetah-v4 --fit-every 2", "fit_every makes no difference to lare-bayes: leave the setting out"),
        (
            "Reacher-v4 --sac.learning-rate 1",
            "sac.learning_rate makes no difference to td3 on Reacher-v4; it has td3.learning_rate: leave the setting out",
        ),
        (
            "Reacher-v4 --draw 1 --function phi.py",
            "draw and candidates choose a recorded function, and a function is given: leave either out",
        ),
        ("Reacher-v4 --seed 2147483647 --seeds 2", "seed = 2147483647 with seeds = 2: the largest seed is 2147483647"),
    ],
)
def test_settings_that_make_no_difference_are_refused(arguments, message, command, tmp_path):
    assert command("train", *arguments.split()) == (2, "", f"lare-rl: {message}\n")
    assert not list(tmp_path.iterdir())


def test_the_version_names_the_commit(command):
    assert command("--version") == (0, f"{source()}\n", "")


def test_methods_are_listed(command):
    status, out, err = command("methods")
    assert (status, err) == (0, "")
    assert [line.split()[0] for line in out.splitlines()[1:] if not line.startswith(" ")] == list(METHODS)


def test_algorithms_are_listed(command):
    status, out, err = command("algorithms")
    assert (status, err) == (0, "")
    assert [line.split()[0] for line in out.splitlines()[1:] if not line.startswith(" ")] == list(ALGORITHMS)


@pytest.mark.parametrize("kind", ["factors", "reward"])
def test_prompt_prints_the_request(command, kind):
    system, user = candidate(read_task("Reacher-v4"), kind)
    printed = f"--- system ---\n{system['content']}\n\n--- user ---\n{user['content']}\n\n"
    assert command("prompt", "Reacher-v4", "--kind", kind) == (0, printed, "")


def test_prompt_of_a_task_of_ones_own(command, spec_file):
    status, out, _ = command("prompt", spec_file(description="Catch the {first} entry."))
    assert status == 0
    assert "# Task\nCatch the {first} entry.\n" in out


def test_design_prints_the_function(command):
    status, out, err = command("design", "Reacher-v4", "--kind", "reward")
    assert (status, err) == (0, "".join(f"candidate {n}: passes\n" for n in range(1, 6)) + "attempt 1: passes\n")
    assert "def evaluation_func(observation, action):\n" in out


def test_design_writes_the_function_once(command, tmp_path):
    status, out, _ = command("design", "Reacher-v4", "--out", "phi.py")
    assert status == 0
    assert out.startswith("wrote phi.py: ")
    written = {name: (tmp_path / name).read_bytes() for name in ("phi.py", "phi.json")}
    assert command("design", "Reacher-v4", "--draw", 1, "--out", "phi") == (
        2,
        "",
        "lare-rl: phi.py exists, and is not overwritten; choose another --out\n",
    )
    assert {name: (tmp_path / name).read_bytes() for name in written} == written


def test_verify_prints_each_check(command, phi, spec_file):
    status, out, err = command("verify", phi, "--task", spec_file())
    assert (status, err) == (0, "")
    assert out.splitlines() == [
        "for Chase: observations of 2 numbers, actions of 1",
        "passed  read",
        "passed  finite",
        "factor  f_near reads observation[0], action[0]",
        "factor  f_effort reads action[0]",
    ]


def test_verify_says_how_much_of_the_score_the_factors_explain(command, phi, spec_file):
    status, out, err = command("verify", phi, "--task", spec_file(), "--fit", "30")
    assert (status, err) == (0, "playing 30 episodes by random actions\n")
    found = re.search(
        r"^Returns of episodes not seen yet, predicted by the factors: R² = (\d\.\d+) .*, with a standard error of [\w ]*0\.0",
        out,
        re.MULTILINE,
    )
    assert found
    assert float(found[1]) > 0.9
    assert (
        "\nFitted to all 30 episodes (such shares may be high where R² is low, because these returns were seen):\nThe f"
        in out
    )
    assert "(before)" not in out
    _, both, _ = command("verify", phi, "--task", spec_file(), "--fit", "30", "--judges", "both")
    assert "before" in both.partition("Fitted to all 30 episodes")[2]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--fit", "10"], "fit = 10: at least 20 episodes are needed"),
        (["--policy", "run"], "--policy plays the episodes for --fit: give --fit a number of episodes, and no --data"),
    ],
)
def test_a_fit_that_says_nothing_is_refused_at_once(command, phi, spec_file, more, message):
    assert command("verify", phi, "--task", spec_file(), *more) == (2, "", f"lare-rl: {message}\n")


def test_verify_prints_every_error(command, spec_file, tmp_path):
    (tmp_path / "bad.py").write_text("import os\ndef evaluation_func(o, a):\n    return [np.clamp(a), open('x')]\n")
    status, out, err = command("verify", "bad.py", "--task", spec_file())
    assert (status, err) == (1, "")
    first, failed, *errors = out.splitlines()
    assert first == "for Chase: observations of 2 numbers, actions of 1"
    assert failed == "FAILED  read"
    assert len(errors) == 2
    assert errors[0].startswith("        E-IMPORT line 1: import os")
    assert errors[1].startswith("        E-NUMPY line 3: np.clamp is not available")
    assert "np.clip" in errors[1]


def test_verify_says_how_a_reply_from_a_chat_is_corrected(command, spec_file, tmp_path):
    source = "def evaluation_func(o, a):\n    return [a[:, 0]]"
    (tmp_path / "reply.json").write_text(json.dumps({"Understand": "", "Analyze": "", "Functions": source}))
    status, out, err = command("verify", "reply.json", "--task", spec_file())
    assert (status, err) == (1, "")
    assert "        E-FORM line 2: factor 1 must be an array of the shape (batch, 1)" in out
    assert out.endswith(
        "Paste the lines after FAILED into the same chat, and ask for the whole reply again, corrected.\n"
    )


def test_verify_gives_advice(command, spec_file, tmp_path):
    (tmp_path / "dull.py").write_text("def evaluation_func(o, a):\n    still = 0 * a\n    return [still, a]\n")
    status, out, _ = command("verify", "dull.py", "--task", spec_file())
    assert status == 0
    assert "advice  factor 'still' never varies on the recorded steps\n" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("none.py --task Reacher-v4", "the function file none.py does not exist"),
        ("phi.py --task Reacher", "no task 'Reacher' (did you mean 'Reacher-v4'?): "),
    ],
)
def test_what_cannot_be_tried_is_status_2(command, phi, arguments, message):
    status, out, err = command("verify", *arguments.split())
    assert (status, out) == (2, "")
    assert err.startswith(f"lare-rl: {message}")


def test_a_new_task_is_written_once(command, tmp_path):
    status, out, err = command("new-task", "Pendulum-v1")
    assert (status, err) == (0, "")
    assert out.splitlines()[0] == "wrote Pendulum-v1.toml"
    written = (tmp_path / "Pendulum-v1.toml").read_bytes()
    again = "lare-rl: Pendulum-v1.toml exists, and is not overwritten; choose another --out\n"
    assert command("new-task", "Pendulum-v1") == (2, "", again)
    assert (tmp_path / "Pendulum-v1.toml").read_bytes() == written
    status, out, _ = command("prompt", "Pendulum-v1.toml")
    assert status == 0
    assert "# Task\nThe inverted pendulum swingup problem" in out


def test_a_new_task_of_two_teams_is_three_files(command, tmp_path):
    status, out, err = command("new-task", "pettingzoo/mpe2.simple_adversary_v3:parallel_env")
    assert (status, err) == (0, "")
    files = [f"simple_adversary_v3{team}.toml" for team in ("", "-adversary", "-agent")]
    first, heading, sentence, *_ = out.splitlines()
    assert (first, heading) == (
        f"wrote {', '.join(files)}",
        "  left out or cut short, because it seems to speak of rewards:",
    )
    assert sentence.startswith("    ")
    assert "reward" in sentence
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(files)


def test_what_a_new_task_lacks_is_said(command):
    status, out, _ = command("new-task", "Hopper-v4", "--out", "hopper.toml")
    assert status == 0
    assert [line for line in out.splitlines() if "fill in" in line] == [
        f"  fill in: {key} (the environment does not document it)" for key in ("description", "observation", "action")
    ]


def test_the_ablation_without_pre_verification_keeps_what_can_be_read(command):
    status, out, err = command("design", "Reacher-v4", "--candidates", 1, "--no-pre-verification")
    assert (status, err) == (0, "")
    assert "def evaluation_func" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            "prompt Reacher",
            "no task 'Reacher' (did you mean 'Reacher-v4'?): neither a file nor one of the shipped tasks, "
            f"{', '.join(shipped_tasks())}",
        ),
        ("design Reacher-v4 --draw 7", "no recording of factors has draw 7; the draws are 0, 1, 2, 3, 4"),
        ("train", "say what to train on: lare-rl train TASK (lare-rl tasks lists them), or lare-rl train --resume DIR"),
        ("train --resume runs/none", "runs/none is not a run: there is no config.json in it"),
        (
            "train Reacher-v4 --resume runs/none",
            "--resume goes on with the run's own settings: give it no task and no other setting than --steps",
        ),
        (
            "train --resume runs/none --seed 1",
            "--resume goes on with the run's own settings: give it no task and no other setting than --steps",
        ),
        ("train Reacher-v4 --function none.py", "the function file none.py does not exist"),
        ("train Reacher-v4 --steps 120", "steps = 120 is not a multiple of rollout_steps = 50: take 100"),
        ("train Reacher-v4 --seed -1", "seed = -1: input should be greater than or equal to 0"),
        (
            "train Reacher-v4 --method magic",
            f"no method 'magic'; the methods are {', '.join(METHODS)}",
        ),
        ("train CN-6 --algorithm ppo", "ppo is for a single agent, and CN-6 is a task of many"),
        (
            "train CN-6 --steps 1000",
            "steps = 1000 is not a multiple of 2050 (rollout_steps = 25 of environments = 82): take 2050",
        ),
        ("train CN-6 --capacity 50", "capacity = 50 is too small: a rollout of CN-6 takes up to 6150"),
        ("train CN-6 --ippo.hidden -1", "hidden.0 = -1: input should be greater than or equal to 1"),
        (
            "train CompetitivePP-6-prey",
            "CompetitivePP-6-prey is one team of particles/CompetitivePP-6: train the task that has both",
        ),
        (
            "train CompetitivePP-6 --function phi.py",
            "CompetitivePP-6 needs one latent function for each of CompetitivePP-6-predator, CompetitivePP-6-prey; 1 were "
            "given",
        ),
        (
            "prompt CompetitivePP-6",
            "CompetitivePP-6 has a latent function for each of its teams: name one of CompetitivePP-6-predator, "
            "CompetitivePP-6-prey instead",
        ),
        (
            "design CompetitivePP-6",
            "CompetitivePP-6 has a latent function for each of its teams: name one of CompetitivePP-6-predator, "
            "CompetitivePP-6-prey instead",
        ),
        ("cross-play . runs/none", ". is not a run: there is no config.json in it"),
        ("evaluate .", ". is not a run: there is no config.json in it"),
        ("report", "say which runs: no run is given"),
        ("report one two", "one is not a run, and contains none"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(command, tmp_path, arguments, message):
    assert command(*arguments.split()) == (2, "", f"lare-rl: {message}\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [["--debug", "evaluate", "none"], ["evaluate", "none", "--debug"]])
def test_debug_shows_where_it_came_from(command, arguments):
    status, out, err = command(*arguments)
    assert (status, out) == (2, "")
    assert err.startswith("Traceback (most recent call last):\n")
    assert err.endswith("\nlare-rl: none is not a run: there is no config.json in it\n")


def test_an_error_of_many_lines_is_printed_in_one(command, spec_file, tmp_path):
    (tmp_path / "bad.py").write_text("import os\ndef evaluation_func(o, a):\n    return [np.load(a)]\n")
    status, _, err = command("train", spec_file(), "--function", "bad.py")
    assert status == 2
    start = "lare-rl: bad.py: the function does not fit task 'Chase': E-IMPORT line 1: import os"
    assert err.startswith(start)
    assert " E-NUMPY line 3: np.load" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    "arguments", [[], ["dance"], ["train", "--colour", "red"], ["prompt", "Reacher-v4", "--kind", "x"]]
)
def test_an_unknown_option_is_status_2(command, arguments):
    status, out, err = command(*arguments)
    assert (status, out) == (2, "")
    assert "Traceback" not in err
    assert "--help" in err


def test_help_names_every_command(command):
    status, out, _ = command("--help")
    assert status == 0
    assert all(name in out for name in cli.COMMANDS)


def test_help_breaks_no_line_where_the_source_does(command):
    """The first of these lines would be that of a command's docstring, the second that of a setting's."""
    status, out, _ = command("train", "--help")
    assert status == 0
    assert "--algorithm" in out
    lines = [line.strip(" |│") for line in out.splitlines()]
    assert "one --function for each, in the order of the task. (repeatable)" not in lines
    assert "qmix if there are a global state and action masks, else ippo." not in lines


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_says_in_words_what_happens_without_an_option(name, command):
    status, out, _ = command(name, "--help")
    assert status == 0
    assert "None" not in out
    assert "(default: )" not in out


def test_help_names_the_type_of_an_option_that_may_be_left_out(command):
    _, out, _ = command("train", "--help")
    for option in (
        "--steps INT",
        "--model STR",
        "--out DIR",
        "--judges {before,after,both}",
        "--credit.hidden [INT [INT ...]]",
        "--td3.gamma FLOAT",
    ):
        assert f" {option} " in out


@pytest.mark.parametrize(
    ("step", "said"),
    [
        (5_000, "the policy of step 5,000, before its first update"),
        (10_000, "the policy of step 10,000, before its first update"),
        (15_000, "the policy of step 15,000"),
    ],
)
def test_a_policy_that_was_saved_before_it_was_trained_is_named(step, said):
    assert when_saved(step, warmup=10_000) == said


def test_from_training_to_report(command, spec_file, phi):
    run = Path("runs/Chase-lare-linear-td3-s0")
    status, out, _ = command("train", spec_file(), *TINY, "--function", phi)
    assert status == 0
    assert out.endswith(f"finished {run}; to see it: lare-rl report {run}\n")
    metrics = (run / "metrics.jsonl").read_bytes()
    assert metrics.count(b"\n") == 2

    status, out, err = command("evaluate", run, "--episodes", 2)
    assert (status, err) == (0, "")
    evaluated, by_chance, difference = out.splitlines()
    assert re.fullmatch(r"seed 0: return -\S+ ± \S+ over 2 episodes", evaluated)
    assert re.fullmatch(r"random actions: return -\S+ ± \S+ over 10 episodes", by_chance)
    assert re.fullmatch(r"difference: \S+ ± \S+ \(± is its standard error\)", difference)
    _, out, _ = command("evaluate", run, "--episodes", 2, "--best")
    assert re.match(r"seed 0: return -\S+ ± \S+ over 2 episodes \(the policy of step [12]00", out)

    assert command("report", run) == (0, f"wrote {run / 'report.html'}\n", DRAWING)
    assert "f_near" in (run / "report.html").read_text(encoding="utf-8")
    assert command("report", run, run, "--out", "both.html") == (0, "wrote both.html\n", DRAWING)
    assert command("evaluate", run, "--video", "film.avi") == (
        2,
        "",
        "lare-rl: film.avi is no name of a video: it ends in .gif, or in .mp4 with the extra lare-rl[video]\n",
    )

    # There is nothing left to do, and nothing is done again. A page that was watched is brought up to date.
    (run / "watch.html").write_text("stale")
    status, out, _ = command("train", "--resume", run)
    assert status == 0
    assert "Step 200 of 200; not running" in (run / "watch.html").read_text(encoding="utf-8")
    assert out.endswith(f"finished {run}; to see it: lare-rl report {run}\n")
    assert (run / "metrics.jsonl").read_bytes() == metrics

    assert command("train", spec_file(), *TINY, "--function", phi, "--out", run) == (
        2,
        "",
        f"lare-rl: {run} exists, and a run never overwrites another: choose another directory, or continue "
        "the run with --resume (lare_rl.resume)\n",
    )
    assert (run / "metrics.jsonl").read_bytes() == metrics

    # What was measured can be drawn without the checkpoint.
    shutil.rmtree(run / "checkpoint")
    assert command("report", run, "--out", "without.html") == (0, "wrote without.html\n", DRAWING)
    assert "Its checkpoint is not there any more" in Path("without.html").read_text(encoding="utf-8")

"""Files for `lare-rl train --config`, and earlier runs in their place."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

import lare_rl
from helpers.toy_envs import PHI, toy_spec
from lare_rl import cli
from lare_rl.cli.parse import parse
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import Settings
from lare_rl.credit.methods import METHODS
from lare_rl.runs.directory import create_run
from lare_rl.runs.plan import load_config

FILE = """
task = "chase.toml"
function = "phi.py"
out = "runs/chase"
method = "lare-bayes"
steps = 250
scale_rewards = true
td3 = { gamma = 0.9 }

[credit]
exact = "spread"
"""


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a file into a directory of its own."""
    (tmp_path / "plans").mkdir()

    def write(text, name="run.toml") -> Path:
        (tmp_path / "plans" / name).write_text(text)
        return Path("plans", name)

    return write


def read_keywords(*arguments):
    """Return the arguments of the command that a command line calls."""
    return parse(cli.COMMANDS, "", ["train", *map(str, arguments)]).keywords


def test_file(write, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    plan = load_config(write(FILE))
    assert (plan.task, plan.function) == ("plans/chase.toml", (Path("plans/phi.py"),))
    assert (plan.out, plan.source) == (Path("plans/runs/chase"), Path("plans/run.toml"))
    settings = {"method": "lare-bayes", "steps": 250, "scale_rewards": True}
    assert plan.settings == Settings(**settings, td3={"gamma": 0.9}, credit={"exact": "spread"})
    values = {"task": "Reacher-v4", "function": ["a.py", "b.py"], "seeds": 2, "ppo": {"anneal": False}}
    plan = load_config(write(json.dumps(values), "run.json"))
    assert (plan.task, plan.function, plan.out) == ("Reacher-v4", (Path("plans/a.py"), Path("plans/b.py")), None)
    assert plan.settings == Settings(seeds=2, ppo={"anneal": False})


def test_options_win_over_the_file(write, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    path = write(FILE.replace("steps = 250", "steps = 250\nseeds = 3"))
    assert read_keywords("--config", path)["settings"] == load_config(path).settings
    options = "--seeds 1 --steps=500 --td3.tau 0.1 --no-scale-rewards --credit.exact last --credit.normalise False"
    settings = read_keywords("--config", path, *options.split())["settings"]
    assert settings == Settings(
        method="lare-bayes",
        seeds=1,  # the default, and not the value of the file
        steps=500,
        td3={"gamma": 0.9, "tau": 0.1},
        credit={"exact": "last", "normalise": False},
    )
    assert settings.credit.model_fields_set == {"exact", "normalise"}  # the algorithm decides the others
    path = write("[ppo]\nanneal = true\nclip = 0.3")
    settings = read_keywords("--config", path, "--ppo.no-anneal")["settings"]
    assert settings.ppo == Settings(ppo={"anneal": False, "clip": 0.3}).ppo


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("run.toml", "stepz = 1", "plans/run.toml: there is no key 'stepz' (did you mean 'steps'?)"),
        ("run.toml", "tasks = 'x'", "the file of a sweep"),
        ("run.toml", "[settings]\nsteps = 1", "write the keys of [settings] outside of this table"),
        ("run.toml", "steps = 'many'", "steps = 'many': input should be a valid integer"),
        ("run.toml", "function = 1", "function = 1: "),
        ("run.toml", "task = 1", "task = 1: input should be a valid string"),
        ("run.toml", "task = Reacher-v4", "a text needs quotes"),
        ("none.toml", None, "plans/none.toml cannot be read: No such file"),
        ("list.json", "[1]", "plans/list.json: it is not valid JSON: it is not an object"),
        ("bad.json", "{", "plans/bad.json: it is not valid JSON"),
        ("copy.json", '{"task_sha256": "0"}', "name the run directory"),
        (".", None, "plans is not a run"),
        ("no-task.toml", "steps = 100", "there is no task in plans/no-task.toml"),
        ("no-file.toml", "task = 'chase.toml'", "there is no task file plans/chase.toml"),
    ],
)
def test_mistakes(write, command, name, text, words):
    if text is not None:
        write(text, name)
    status, out, err = command("train", "--config", Path("plans", name))
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert words in err


@pytest.fixture
def trained(monkeypatch):
    """Return the arguments of each call of `lare_rl.train`."""
    calls = []

    def record(task, settings, **options):
        calls.append((task, settings, options))
        return SimpleNamespace(directory=options["out"], config=SimpleNamespace(task=toy_spec()))

    monkeypatch.setattr(lare_rl, "train", record, raising=False)
    return calls


def test_command_trains_what_the_file_says(write, spec_file, command, trained, phi, tmp_path):
    write(spec_file().read_text(), "chase.toml")
    write(PHI, "phi.py")
    path = write(FILE)
    assert command("train", "--config", path)[0] == 0
    assert command("train", "--config", path, "--out", "other", "--method", "bayes")[0] == 0
    run = create_run(tmp_path / "run", toy_spec(), resolve(load_config(path).settings, toy_spec()), [phi])
    status, _, err = command("train", "--config", run.directory, "--algorithm", "sac")
    assert (status, f"rollout_steps = {run.config.settings.rollout_steps}" in err) == (0, True)
    (task, settings, options), (_, other_settings, other_options), (_, repeated, _) = trained
    assert (task.name, options["out"], other_options["out"]) == ("Chase", Path("plans/runs/chase"), Path("other"))
    assert (settings.steps, other_settings.method) == (250, "bayes")
    assert (repeated.algorithm, repeated.steps) == ("sac", run.config.settings.steps)
    assert options["function"][0].source == PHI.strip("\n")
    assert other_options["function"] is None  # another method needs none
    status, _, err = command("train", "--resume", "runs/x", "--config", path)
    assert (status, "--resume" in err and "--config" in err) == (2, True)


@pytest.mark.parametrize("method", ["dense", "rd", "lare-bayes", "llm-reward"])
def test_settings_of_a_run_are_those_of_its_repetition(method, phi, reward, tmp_path):
    task = toy_spec()
    settings = Settings(method=method, steps=240, rollout_steps=12, evaluate_every=60, seed=3, td3={"gamma": 0.9})
    resolved = resolve(settings, task)
    needs_phi = METHODS[method].needs_phi
    function = reward if METHODS[method].phi_kind == "reward" else phi
    create_run(tmp_path / "run", task, resolved, [function] * needs_phi)
    plan = load_config(tmp_path / "run")
    assert resolve(plan.settings, plan.task) == resolved
    assert plan.task == task
    assert [used.digest for used in plan.function or ()] == [function.digest] * needs_phi

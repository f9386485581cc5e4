"""Every command and every snippet of the documentation runs, page by page, from top to bottom: `make docs`.

A page is run as it stands, but for its budgets: `CUTS` makes numbers of steps and episodes small, `miniature` networks and
batches. A function of the table `BEFORE` makes whatever the reader of a page already has (a log, a server).
"""

import json
import os
import re
import shlex
import sys
import tomllib
from pathlib import Path
from types import ModuleType, SimpleNamespace

import gymnasium
import numpy as np
import pytest

import lare_rl
from helpers.chat_servers import Server, text_completion
from lare_rl.compare import bootstrap
from lare_rl.runs.config_file import make_config
from lare_rl.sweep import processes
from lare_rl.sweep.sweep import read_sweep
from lare_rl.tasks import spec
from lare_rl.training import train as training
from lare_rl.util.safe_io import read_toml
from paper.exhibits import Exhibit
from paper.trained import MEANING

pytestmark = pytest.mark.docs

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/*.md")])
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
RUNNABLE = ("sh", "python", "toml")


def blocks(page):
    """Language and text of every block that is to be run."""
    return [(name, text) for name, text in BLOCK.findall(page.read_text(encoding="utf-8")) if name in RUNNABLE]


WITH_BLOCKS = [str(page.relative_to(ROOT)) for page in PAGES if blocks(page)]

SELF_HOSTED = re.compile(r"http://localhost:(11434|8000)/v1")

CUTS = {
    r"HalfCheetah-v4": "Reacher-v4",
    r"--steps 100000": "--steps 200 --td3.warmup 100 --evaluation-episodes 1",
    r"--resume runs/lare --steps 200000": "--resume runs/lare --steps 400",
    r"--steps 20000 --td3.warmup 1000": "--steps 400 --td3.warmup 100 --evaluation-episodes 1",
    r"--steps 40000": "--steps 600",
    r"steps=(100|20)_000": "steps=400, evaluation_episodes=1",
    r"--seeds 3|seeds=3": lambda match: match[0].replace("3", "2"),
    r"(lare-rl train (CN|PP|CompetitivePP|TriangleArea)-?6?.*)": r"\1 --steps 200 --environments 4 --evaluation-episodes 1",
    r"(lare-rl train spread.toml.*)": r"\1 --steps 2000 --evaluation-episodes 1",
    r"lare-rl train SMAX-\w+": "lare-rl train SMAX-2s3z",
    r"--qmix.* --steps": "--steps",
    r" --processes 2": "",
    r"(lare-rl train SMAX-.* --algorithm ippo.*)": r"\1 --steps 2050 --environments 2 --evaluation-episodes 1",
    r"(lare-rl train SMAX-\S+(?: --method \S+)?)(?: --steps \d+)? *$": r"\1 --steps 1200 --environments 2 --evaluation-episodes 1",
    r"(lare-rl train \S+ --method \w+-?\w*)$": r"\1 --steps 200 --td3.warmup 100 --evaluation-episodes 1",
    r"--budget laptop|reproduce errors": lambda match: f"{match[0].split(' --')[0]} --budget smoke",
    r"--episodes 20|episodes=20": lambda match: match[0].replace("20", "1"),
    r"learn\(1_000_000": "learn(1100",
    r"http://localhost:5000": "file:mlruns",
    r"runs/\.\.\.": "runs/Reacher-v4-lare-bayes-td3-s0",
}
"""What is run instead of what stands there, by regular expression: short runs, on a task of short episodes."""


def cut(text):
    for pattern, less in CUTS.items():
        text = re.sub(pattern, less, text, flags=re.MULTILINE)
    return text


class Page:
    """What a page is run with: a directory, variables of the environment, names of Python."""

    def __init__(self, command, monkeypatch, directory):
        self.command, self.patch, self.directory = command, monkeypatch, directory
        self.names = {}

    def define(self, code):
        """Define names that the page assumes."""
        exec(code, self.names)

    def write(self, name, text):
        path = self.directory / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")

    def serve(self, source):
        """A language model that always writes the same function, wherever the page says that one is."""
        server = Server(lambda handler: handler.send(200, json.dumps(text_completion(to_reply(source))).encode()))
        self.patch.setenv("OPENAI_BASE_URL", server.url)
        self.patch.setenv("OPENAI_API_KEY", "key")
        self.url = server.url

    def shell(self, line):
        """A command, or an assignment."""
        words = shlex.split(line, comments=True)
        if not words:
            return
        match words:
            case ["export", *assignments]:
                for assignment in assignments:
                    name, value = assignment.split("=", 1)
                    if value != "...":
                        self.patch.setenv(name, value.replace("$PWD", os.getcwd()))
            case ["lare-rl", *arguments]:
                status, out, err = self.command(*arguments)
                undrawn = "--video" in arguments and "cannot be drawn here" in err  # a machine without graphics
                assert status == 0 or undrawn, f"{line}\n{out}\n{err}"
                if arguments[0] == "new-task":  # the reader fills it in
                    draft = Path(arguments[-1])
                    draft.write_text(draft.read_text().replace(spec.FILL_IN, "what it is"))
            case ["make", target]:
                assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
            case ["pip", "install", *packages]:
                project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
                extras = {f"lare-rl[{name}]" for name in project["optional-dependencies"]}
                developed = " ".join(project["optional-dependencies"]["dev"])
                assert all(package in extras or package in developed for package in packages)
            case ["python", path, *_] | [".venv/bin/python", "-m", "pytest", path]:
                assert (ROOT / path).exists()
            case [".venv/bin/ruff", *_]:
                assert "ruff check" in (ROOT / "Makefile").read_text()
            case _:
                pytest.fail(f"nothing is known of {line!r}")

    def run(self, language, text):
        if language == "sh":
            for line in text.splitlines():
                self.shell(SELF_HOSTED.sub(self.url, cut(line.split("  #")[0].strip())))
        elif language == "python":
            exec(compile(SELF_HOSTED.sub(self.url, cut(text)), "snippet", "exec"), self.names)

    url = "none"


def made_up(job, cores, running):
    """Instead of training a run of a sweep: metrics as it would have them."""
    job.directory.mkdir(parents=True)
    (job.directory / "config.json").write_text(make_config(job.task, job.resolved, ()).model_dump_json())
    lines = [
        {"step": job.resolved.steps, "seed": seed, **dict.fromkeys(MEANING, seed + 1.0)}
        for seed in job.resolved.all_seeds
    ]
    (job.directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def to_python(page, number):
    """One of its blocks."""
    return [text for language, text in blocks(ROOT / page) if language == "python"][number]


def to_toml(page, number):
    return [text for language, text in blocks(ROOT / page) if language == "toml"][number]


PENDULUM = to_python("docs/bring-your-own-task.md", 0)
STUDY = to_toml("docs/sweeps.md", 0).replace("processes = 2", "processes = 1")


def a_study(page):
    """The files that the study names; its runs are not trained."""
    page.write("study.toml", cut(STUDY))
    page.write("my-task.toml", to_toml("docs/bring-your-own-task.md", 0).replace('"Pendulum"', '"MyTask"'))
    page.write("phi.py", PENDULUM)
    page.patch.setattr(processes, "train_in_process", made_up)
    page.patch.setattr(bootstrap, "REPETITIONS", 50)


def logs(page):
    """Episodes of HalfCheetah as files, and as a data set of Minari's."""
    import minari
    from minari.data_collector import EpisodeBuffer

    page.patch.setenv("MINARI_DATASETS_PATH", str(page.directory / "minari"))
    random = np.random.default_rng(0)

    def episode(steps=60):
        observations = random.normal(size=(steps + 1, 17)) + random.normal(size=17)
        rewards = observations[1:, 8] + 1.0
        return (
            observations,
            random.normal(size=(steps, 6)),
            rewards,
            np.zeros(steps, bool),
            np.arange(steps) == steps - 1,
        )

    (page.directory / "runs" / "2024").mkdir(parents=True)
    names = ("observations", "actions", "rewards", "terminations", "truncations")
    for number in range(90):
        np.savez(page.directory / "runs" / "2024" / f"{number}.npz", **dict(zip(names, episode(), strict=True)))
    buffers = [
        EpisodeBuffer(
            observations=seen, actions=action, rewards=list(paid), terminations=list(over), truncations=list(cut)
        )
        for seen, action, paid, over, cut in (episode() for _ in range(90))
    ]
    box = gymnasium.spaces.Box
    minari.create_dataset_from_buffers(
        "mujoco/hopper/medium-v0",
        buffers,
        observation_space=box(-np.inf, np.inf, (17,), np.float64),
        action_space=box(-np.inf, np.inf, (6,), np.float64),
    )
    page.serve(lare_rl.design("HalfCheetah-v4").source)


def a_run(page):
    settings = lare_rl.Settings(method="lare-bayes", steps=400, evaluation_episodes=1, seeds=2)
    return lare_rl.train("Reacher-v4", settings, out="runs/lare", listeners=[])


def for_the_api(page):
    run = a_run(page)
    page.patch.setenv("WANDB_MODE", "offline")
    page.patch.setenv("WANDB_SILENT", "true")
    page.patch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    page.names["model"] = SimpleNamespace(name="says", reply=lambda messages, sample: to_reply(run.functions[0].source))
    page.define(
        "import gymnasium, numpy as np\n"
        "envs = gymnasium.make_vec('Reacher-v4', num_envs=4)\n"
        "observation, _ = envs.reset(seed=0)\n"
        "action = envs.action_space.sample()\n"
        "next_observation, reward, terminated, truncated, _ = envs.step(action)\n"
        "before, after = observation, next_observation\n"
    )


def to_reply(source):
    return json.dumps({"Understand": "", "Analyze": "", "Functions": source})


def an_export(page):
    run = a_run(page)
    lare_rl.export_run(run, page.directory / "exported")
    page.patch.chdir(page.directory / "exported")
    page.patch.syspath_prepend(page.directory / "exported")
    page.define(
        "import numpy as np\n"
        "observations = before = after = np.ones((5, 11), np.float32)\naction = np.ones((5, 2), np.float32)"
    )


def a_plugin(page):
    """The snippets are one module, which can be imported by its name."""
    module = ModuleType("my_plugin")
    page.patch.setitem(sys.modules, module.__name__, module)
    page.names = module.__dict__


def a_function(page):
    lare_rl.design("Reacher-v4").save(page.directory / "phi.py")


def a_user(page):
    page.serve(PENDULUM)


def for_the_readme(page):
    """A study of one task, whose runs can be compared."""
    a_study(page)
    (page.directory / "phi.py").unlink()
    page.write("study.toml", cut(STUDY).replace(', "my-task.toml"', "").replace('MyTask = ["phi.py"]', ""))
    page.serve(PENDULUM)


BEFORE = {
    "README.md": for_the_readme,
    "docs/api.md": for_the_api,
    "docs/bring-your-own-task.md": a_user,
    "docs/export.md": an_export,
    "docs/extending.md": a_plugin,
    "docs/logs.md": logs,
    "docs/plugs/sb3.md": a_function,
    "docs/reproduce.md": a_study,
    "docs/runs.md": a_run,
    "docs/starcraft.md": a_study,
    "docs/sweeps.md": a_study,
}
"""What the reader of a page has."""

EXCERPTS = {"docs/plugs/others.md": ("tianshou_td3.py", "skrl_td3.py", "rllib_ppo.py")}
"""Pages whose snippets are lines of examples, which `test_examples.py` runs where the library is installed."""


@pytest.fixture
def miniature(monkeypatch):
    """Every run that begins in this process is as it is asked for, but for small networks and little work for them."""
    decide = training.resolve

    def smaller(settings, task):
        plan = decide(settings, task)
        credit = plan.credit.model_copy(update={"hidden": (8,), "drawn_steps": 4, "steps": 16})
        algorithm = plan.hyperparameters
        less = {"hidden": 8 if plan.algorithm in ("qmix", "vdn") else (8,), "batch_size": 8, "epochs": 1}
        less = {name: value for name, value in less.items() if name in type(algorithm).model_fields}
        changes = {"credit": credit, "hyperparameters": algorithm.model_copy(update=less), "fit_updates": 1}
        return plan.model_copy(update=changes)

    monkeypatch.setattr(training, "resolve", smaller)


@pytest.mark.usefixtures("miniature")
@pytest.mark.filterwarnings("ignore:.*v4 is out of date", "ignore::UserWarning:minari")
@pytest.mark.parametrize("name", [name for name in WITH_BLOCKS if name not in EXCERPTS])
def test_a_page_runs(name, command, monkeypatch, tmp_path):
    monkeypatch.delitem(sys.modules, "exported", raising=False)  # that of another page
    page = Page(command, monkeypatch, tmp_path)
    BEFORE.get(name, lambda page: None)(page)
    for language, text in blocks(ROOT / name):
        page.run(language, text)


@pytest.mark.parametrize(("name", "examples"), EXCERPTS.items())
def test_an_excerpt_is_in_its_example(name, examples):
    for example, (_, text) in zip(examples, blocks(ROOT / name), strict=True):
        whole = re.sub(r"\s+", "", (ROOT / "examples" / example).read_text(encoding="utf-8"))
        for line in text.splitlines():
            assert re.sub(r"\s+", "", line.split("  #")[0]) in whole


def test_task_files_are_task_files(tmp_path):
    """Those of one agent and of many; and of two teams, where the page leaves out the texts."""
    for number in range(4):
        text = to_toml("docs/bring-your-own-task.md", number)
        if "description = " not in text:
            text += "".join(f'{key} = "what it is"\n' for key in ("description", "observation", "action"))
        name = tomllib.loads(text)["name"]
        (tmp_path / ("simple_adversary_v3-adversary.toml" if name == "adversary" else f"{name}.toml")).write_text(text)
    other = (tmp_path / "simple_adversary_v3-adversary.toml").read_text().replace("adversary_*", "agent_*")
    (tmp_path / "simple_adversary_v3-agent.toml").write_text(
        re.sub('(name|team) = "adversary"', r'\1 = "agent"', other)
    )
    loaded = [lare_rl.load_task(tmp_path / f"{name}.toml") for name in ("Pendulum", "spread", "simple_adversary_v3")]
    assert [len(task.roles) for task in loaded] == [1, 1, 2]


def test_a_study_can_be_trained(monkeypatch, tmp_path):
    a_study(Page(None, monkeypatch, tmp_path))
    _, jobs = read_sweep(tmp_path / "study.toml")
    assert len(jobs) == 2 * (2 + 2 + 3 + 1)


def test_an_exhibit_of_ones_own():
    assert list(Exhibit(**read_toml(to_toml("docs/reproduce.md", 0))).contenders) == ["64 units", "256 units"]

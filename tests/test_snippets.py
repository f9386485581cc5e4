"""All commands and snippets of the documentation run, page by page, and so does the notebook: `make docs`.

Only budgets are changed: `CUTS` makes numbers of steps and episodes small, `small_runs` makes networks and batches small. A function
of the table `PREPARE` makes what the reader of a page already has (a log, a server).
"""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType, SimpleNamespace

import gymnasium
import numpy as np
import pytest

import lare_rl
from helpers.chat_servers import Server, reply_with
from helpers.scripted_model import to_reply
from helpers.untrained_runs import invent_training
from lare_rl.sweep import processes
from lare_rl.tasks import spec
from lare_rl.training import train as training
from paper.trained import MEANING

pytestmark = pytest.mark.docs

ROOT = Path(__file__).parents[1]
SKILL = ROOT / "skills" / "lare" / "SKILL.md"
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/*.md"), SKILL])
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
RUNNABLE = ("sh", "python", "toml")


def blocks(page):
    """Return language and text of each block to run."""
    return [(name, text) for name, text in BLOCK.findall(page.read_text(encoding="utf-8")) if name in RUNNABLE]


PAGES_WITH_BLOCKS = [str(page.relative_to(ROOT)) for page in PAGES if blocks(page)]

RUN_NOTEBOOK = """
import sys
import nbformat
from nbclient import NotebookClient
notebook = nbformat.read(sys.argv[1], as_version=4)
NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
print(sum(bool(cell.get("outputs")) for cell in notebook.cells))
"""
SELF_HOSTED = re.compile(r"http://localhost:(11434|8000)/v1")

CUTS = {
    r"HalfCheetah-v4": "Reacher-v4",
    r"--steps 100000": "--steps 200 --td3.warmup 100 --evaluation-episodes 1",
    r"--resume runs/lare --steps 200000": "--resume runs/lare --steps 600",
    r"--steps 20000 --td3.warmup [12]000": "--steps 400 --td3.warmup 100 --evaluation-episodes 1",
    r"--steps 40000": "--steps 600",
    r"--steps 50000": "--steps 400 --rollout-steps 200 --evaluation-episodes 1",
    r"--resume runs/first --steps 205000": "--resume runs/first --steps 400",
    r"steps=(100|20)_000": "steps=400, evaluation_episodes=1",
    r"learning_starts=2000": "learning_starts=1000",
    r"--seeds 3|seeds=3": lambda match: match[0].replace("3", "2"),
    r"(lare-rl train (CN|CompetitivePP)-6.*)": r"\1 --steps 200 --environments 4 --evaluation-episodes 1",
    r"(lare-rl train spread.toml.*)": r"\1 --steps 2000 --evaluation-episodes 1",
    r"--qmix.* --steps": "--steps",
    r" --processes 2": "",
    r"(lare-rl train SMAX-\S+(?: --method \S+)?)(?: --steps \d+)? *$": r"\1 --steps 1200 --environments 2 --evaluation-episodes 1",
    r"--budget laptop|reproduce errors": lambda match: f"{match[0].split(' --')[0]} --budget smoke",
    r"--episodes 20|episodes=20": lambda match: match[0].replace("20", "1"),
    r"learn\((10|100|1_000)_000": "learn(1100",
    r"http://localhost:5000": "file:mlruns",
}
"""Replacements by regular expression: short runs, on a task of short episodes."""


def shorten(text):
    for pattern, replacement in CUTS.items():
        text = re.sub(pattern, replacement, text, flags=re.MULTILINE)
    return text


class Page:
    """The state in which a page runs: a directory, variables of the environment, names of Python."""

    url = "none"

    def __init__(self, command, monkeypatch, directory):
        self.command, self.patch, self.directory = command, monkeypatch, directory
        self.names = {}

    def write(self, name, text):
        path = self.directory / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")

    def serve(self, source):
        """Start a language model that always writes the same function; it answers at all addresses on the page."""
        server = Server(reply_with(to_reply(source)))
        self.patch.setenv("OPENAI_BASE_URL", server.url)
        self.patch.setenv("OPENAI_API_KEY", "key")
        self.url = server.url

    def shell(self, line):
        """Run a command, or an assignment."""
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
                pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
                names = set(pyproject["project"]["optional-dependencies"])
                lists = [re.fullmatch(r"(?:lare-rl|\.)\[(.*)\]", package) for package in packages]
                developed = str(pyproject["dependency-groups"])
                for package, extras in zip(packages, lists, strict=True):
                    assert set(extras[1].split(",")) <= names if extras else package == "-e" or package in developed
            case ["python", path, *_] | [".venv/bin/python", "-m", "pytest", path]:
                assert (ROOT / path).exists()
            case [".venv/bin/ruff", *_]:
                assert "ruff check" in (ROOT / "Makefile").read_text()
            case _:
                pytest.fail(f"nothing is known of {line!r}")

    def run(self, language, text):
        if language == "sh":
            for line in text.splitlines():
                self.shell(SELF_HOSTED.sub(self.url, shorten(line.split("  #")[0].strip())))
        elif language == "python":
            exec(compile(SELF_HOSTED.sub(self.url, shorten(text)), "snippet", "exec"), self.names)


def first_block(page, language):
    return next(text for name, text in blocks(ROOT / page) if name == language)


PENDULUM = first_block("docs/tutorials/your-own-environment.md", "python")
PENDULUM_TASK = first_block("docs/tutorials/your-own-environment.md", "toml")
STUDY = first_block("docs/how-to/sweeps.md", "toml").replace("processes = 2", "processes = 1")
API_NAMES = """
import gymnasium, numpy as np
envs = gymnasium.make_vec('Reacher-v4', num_envs=4)
observation, _ = envs.reset(seed=0)
action = envs.action_space.sample()
next_observation, reward, terminated, truncated, _ = envs.step(action)
before, after = observation, next_observation
"""
EXPORT_NAMES = """
import numpy as np
observations = before = after = np.ones((5, 11), np.float32)
action = np.ones((5, 2), np.float32)
"""


def write_study(page):
    """Write the files that the study names. Its runs are not trained."""
    page.write("study.toml", shorten(STUDY))
    page.write("my-task.toml", PENDULUM_TASK.replace('"Pendulum"', '"MyTask"'))
    page.write("phi.py", PENDULUM)
    train = invent_training(lambda job, seed: dict.fromkeys(MEANING, seed + 1.0))
    page.patch.setattr(processes, "train_in_process", train)


def write_pendulum(page):
    """Write the task and the function of the tutorial."""
    page.write("pendulum.toml", PENDULUM_TASK)
    page.write("phi.py", PENDULUM)


def design_pendulum(page):
    """Write the function, which the reader saves, start the model that the page asks, and link the examples."""
    page.write("phi.py", PENDULUM)
    (page.directory / "examples").symlink_to(ROOT / "examples")
    page.patch.syspath_prepend(ROOT / "examples")
    page.serve(PENDULUM)


def train_pendulum(page):
    write_pendulum(page)
    settings = lare_rl.Settings(steps=400, evaluation_episodes=1, td3={"warmup": 200})
    lare_rl.train(
        "pendulum.toml",
        settings,
        function=lare_rl.load_function("phi.py", "pendulum.toml"),
        out="runs/pendulum",
        listeners=[],
    )


def write_readme_study(page):
    """Write a study of one task, whose runs can be compared."""
    write_study(page)
    (page.directory / "phi.py").unlink()
    page.write("study.toml", shorten(STUDY).replace(', "my-task.toml"', "").replace('MyTask = ["phi.py"]', ""))
    page.serve(PENDULUM)


def write_logs(page):
    """Write episodes of HalfCheetah as files, and as a Minari data set."""
    import minari
    from minari.data_collector import EpisodeBuffer

    page.patch.setenv("MINARI_DATASETS_PATH", str(page.directory / "minari"))
    random = np.random.default_rng(0)
    (page.directory / "runs" / "2024").mkdir(parents=True)
    buffers = []
    for number in range(180):
        observations = random.normal(size=(61, 17)) + random.normal(size=17)
        episode = {
            "observations": observations,
            "actions": random.normal(size=(60, 6)),
            "rewards": observations[1:, 8] + 1.0,
            "terminations": np.zeros(60, bool),
            "truncations": np.arange(60) == 59,
        }
        if number < 90:
            np.savez(page.directory / "runs" / "2024" / f"{number}.npz", **episode)
        else:
            lists = {name: list(episode[name]) for name in ("rewards", "terminations", "truncations")}
            buffers.append(EpisodeBuffer(**episode | lists))
    spaces = {
        f"{name}_space": gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)
        for name, size in (("observation", 17), ("action", 6))
    }
    minari.create_dataset_from_buffers("mujoco/hopper/medium-v0", buffers, **spaces)
    page.serve(lare_rl.design("HalfCheetah-v4").source)


def train_run(page):
    settings = lare_rl.Settings(method="lare-bayes", steps=400, evaluation_episodes=1, seeds=2)
    return lare_rl.train("Reacher-v4", settings, out="runs/lare", listeners=[])


def prepare_runs(page):
    train_run(page)
    page.write("cheetah.toml", shorten(first_block("docs/how-to/runs.md", "toml")))


def prepare_api(page):
    source = train_run(page).functions[0].source
    for name, value in (("WANDB_MODE", "offline"), ("WANDB_SILENT", "true"), ("MLFLOW_ALLOW_FILE_STORE", "true")):
        page.patch.setenv(name, value)
    page.names["model"] = SimpleNamespace(name="model", reply=lambda messages, sample: to_reply(source))
    exec(API_NAMES, page.names)


def export_policy(page):
    directory = page.directory / "exported"
    lare_rl.export_run(train_run(page), directory)
    page.patch.chdir(directory)
    page.patch.syspath_prepend(directory)
    exec(EXPORT_NAMES, page.names)


def prepare_models(page):
    page.serve(PENDULUM)
    page.write("pendulum.toml", PENDULUM_TASK)
    page.names["my_client"] = SimpleNamespace(ask=lambda messages: to_reply(PENDULUM))
    name = "lare_rl.integrations.pydantic_ai"  # its library may be missing; tests/integrations has its tests
    adapter = SimpleNamespace(pydantic_ai_model=lambda name: page.names["my_model"])
    page.patch.setitem(sys.modules, name, adapter)


def prepare_plugin(page):
    """Make the snippets one module, which can be imported by its name."""
    module = ModuleType("my_plugin")
    page.patch.setitem(sys.modules, module.__name__, module)
    page.names = module.__dict__


PREPARE = {
    "README.md": write_readme_study,
    "docs/how-to/python.md": prepare_api,
    "docs/tutorials/your-own-environment.md": design_pendulum,
    "docs/how-to/scores.md": write_pendulum,
    "docs/how-to/write-phi.md": write_pendulum,
    "docs/how-to/poor-policies.md": train_pendulum,
    "docs/how-to/language-models.md": prepare_models,
    "docs/how-to/export.md": export_policy,
    "docs/how-to/extend.md": prepare_plugin,
    "docs/how-to/jax-environments.md": lambda page: page.write(
        "pendulum.toml", first_block("docs/how-to/jax-environments.md", "toml")
    ),
    "docs/tutorials/your-own-logs.md": write_logs,
    "docs/how-to/libraries/sb3.md": lambda page: lare_rl.design("Reacher-v4").save(page.directory / "phi.py"),
    "docs/how-to/reproduce.md": write_study,
    "docs/how-to/runs.md": prepare_runs,
    "docs/reference/files.md": train_run,
    "docs/reference/starcraft.md": write_study,
    "skills/lare/SKILL.md": lambda page: page.write("phi.py", first_block("skills/lare/SKILL.md", "python")),
    "docs/how-to/sweeps.md": write_study,
}
"""What the reader of a page already has."""

NEEDS = {"docs/how-to/jax-environments.md": "gymnax"}
"""Pages that need a package which cannot be installed beside those of development."""
EXCERPTS = {"docs/how-to/libraries/others.md": ("tianshou_td3.py", "skrl_td3.py", "rllib_ppo.py")}
"""Pages whose snippets are lines of examples, which `test_examples.py` runs if the library is installed."""


@pytest.fixture
def small_runs(monkeypatch):
    """Give every run in this process small networks and few updates."""
    resolve = training.resolve

    def resolve_small(settings, task):
        resolved = resolve(settings, task)
        credit = resolved.credit.model_copy(update={"hidden": (8,), "sampled_steps": 4, "batch_steps": 16})
        fields = type(resolved.hyperparameters).model_fields
        small = {"hidden": 8 if resolved.algorithm in ("qmix", "vdn") else (8,), "batch_size": 8, "epochs": 1}
        small = resolved.hyperparameters.model_copy(update={name: small[name] for name in small if name in fields})
        return resolved.model_copy(update={"credit": credit, "hyperparameters": small, "fit_updates": 1})

    monkeypatch.setattr(training, "resolve", resolve_small)


@pytest.mark.usefixtures("small_runs")
@pytest.mark.filterwarnings("ignore:.*v4 is out of date", "ignore::UserWarning:minari")
@pytest.mark.parametrize("name", [name for name in PAGES_WITH_BLOCKS if name not in EXCERPTS])
def test_page(name, command, monkeypatch, tmp_path):
    monkeypatch.delitem(sys.modules, "exported", raising=False)  # of another page
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], exc_type=ImportError)
    page = Page(command, monkeypatch, tmp_path)
    PREPARE.get(name, lambda page: None)(page)
    for language, text in blocks(ROOT / name):
        page.run(language, text)


@pytest.mark.parametrize(("name", "examples"), EXCERPTS.items())
def test_excerpts_are_in_their_examples(name, examples):
    for example, (_, text) in zip(examples, blocks(ROOT / name), strict=True):
        program = re.sub(r"\s+", "", (ROOT / "examples" / example).read_text(encoding="utf-8"))
        for line in text.splitlines():
            assert re.sub(r"\s+", "", line.split("  #")[0]) in program


def test_notebook(tmp_path):
    environment = os.environ | {"STEPS": "1000", "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    command = [sys.executable, "-c", RUN_NOTEBOOK, str(ROOT / "examples" / "first_run.ipynb")]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "6\n"), done.stderr[-2000:]
    assert (tmp_path / "report.html").is_file()

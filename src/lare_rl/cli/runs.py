"""The commands for runs: `train`, `evaluate`, `report`, `export` and `cross-play`."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import Positional

from lare_rl.cli.design import BUDGET, REQUESTS
from lare_rl.cli.terminal import RunDirectories, RunDirectory, progress, say, show
from lare_rl.config.settings import ResolvedSettings, Settings, set_in_vain
from lare_rl.errors import LareError, pip_install

if TYPE_CHECKING:
    from lare_rl.llm.model import Model
    from lare_rl.training.progress import Listener

DEFAULTS = Settings()


def train(
    task: Annotated[Positional[str | None], tyro.conf.arg(metavar="[TASK]")] = None,
    settings: Annotated[Settings, tyro.conf.arg(name="")] = DEFAULTS,
    function: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="FILE")] = (),
    model: str | None = None,
    base_url: str | None = None,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    resume: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    tensorboard: bool = False,
    wandb: Annotated[str | None, tyro.conf.arg(metavar="PROJECT")] = None,
    mlflow: Annotated[str | None, tyro.conf.arg(metavar="EXPERIMENT")] = None,
    watch: bool = False,
) -> None:
    """Train on a task's episodic rewards. Ctrl-C saves and stops; --resume continues.

    Args:
        task: a shipped name (see `lare-rl tasks`), or the path of a task file. Not given with --resume.
        function: a latent function (.py), or a reply with one (.json), to use instead of a recorded one; verified before it is
            run. Where several teams learn, one --function for each, in the order of the task.
        model: with --reflect-every, the model to ask: the path of a recording (.json), or the name of a model behind an
            OpenAI-compatible endpoint.
        base_url: the endpoint; the default is OPENAI_BASE_URL, or else OpenAI's.
        out: the run directory, which must not exist; the default is runs/TASK-METHOD-ALGORITHM-sSEED.
        resume: a run directory to continue, from its last checkpoint and with its own settings. With --steps, a finished run is
            extended.
        tensorboard: write TensorBoard events into the run directory too (needs the extra lare-rl[tensorboard]).
        wandb: send the metrics of each seed to a project of Weights & Biases too (needs the extra lare-rl[wandb]).
        mlflow: send the metrics of each seed to an experiment of MLflow too (needs the extra lare-rl[mlflow]).
        watch: write verdict and curves to watch.html in the run directory after every evaluation, and open it in the browser.
    """
    import lare_rl
    from lare_rl.config.resolve import decide
    from lare_rl.latent.function import CHANGED, per_role
    from lare_rl.latent.saved import load
    from lare_rl.runs.directory import default_directory, open_run
    from lare_rl.training.train import check_given

    if resume is not None:
        if (task, function, out, settings.model_copy(update={"steps": None})) != (None, (), None, DEFAULTS):
            raise LareError(
                "--resume goes on with the run's own settings: give it no task and no other setting than --steps"
            )
        config = open_run(resume).config
        asked = model_of(model, base_url, config.task.name)
        listeners = [*listeners_of(wandb, mlflow, config.settings), *page_of(resume, watch)]
        run = lare_rl.resume(resume, steps=settings.steps, model=asked, tensorboard=tensorboard, listeners=listeners)
    elif task is None:
        raise LareError(
            "say what to train on: lare-rl train TASK (lare-rl tasks lists them), or lare-rl train --resume DIR"
        )
    else:
        spec = lare_rl.load_task(task)
        resolved = decide(settings, spec)
        for in_vain in set_in_vain(settings, resolved, spec).values():
            raise LareError(f"{in_vain}: leave the setting out")
        if function:
            check_given(resolved)
        functions = [load(file, role) for file, role in per_role(function, spec)] if function else None
        for one in functions or ():
            if one.changed:
                progress(
                    f"the function by {one.model.removesuffix(CHANGED)} was changed after it was saved: its hash differs"
                )
        asked = model_of(model, base_url, spec.name)
        out = out or default_directory(spec, resolved)
        run = lare_rl.train(
            spec,
            settings,
            function=functions,
            model=asked,
            out=out,
            tensorboard=tensorboard,
            listeners=[*listeners_of(wandb, mlflow, resolved), *page_of(out, watch)],
        )
    say(f"finished {run.directory}; to see it: lare-rl report {run.directory}")


def listeners_of(wandb: str | None, mlflow: str | None, settings: ResolvedSettings) -> "list[Listener]":
    """The terminal, and the tracking services that the user asked for."""
    from lare_rl.training.progress import Terminal
    from lare_rl.training.trackers import MLflow, WeightsAndBiases

    told: list[Listener] = [Terminal()]
    kept = settings.model_dump(mode="json")
    if wandb is not None:
        told.append(WeightsAndBiases(project=wandb, config=kept))
    if mlflow is not None:
        told.append(MLflow(mlflow, parameters=kept))
    return told


def page_of(directory: Path, watch: bool) -> "list[Listener]":
    """The page that shows the run, if the user asks for it, or asked for it before the run was stopped."""
    if not watch and not directory.exists():
        return []
    from lare_rl.report.live_page import PAGE, LivePage

    page = directory / PAGE
    if watch:
        progress(f"to watch it: {page}")
    return [LivePage(directory, browser=watch)] if watch or page.exists() else []


def model_of(model: str | None, base_url: str | None, task: str) -> "Model | None":
    """The model that a run asks for better functions; None if the user named none."""
    from lare_rl.llm.budget import Budget
    from lare_rl.llm.live import LiveModel
    from lare_rl.llm.model import recorded_model

    if base_url is not None and (model is None or model.endswith(".json")):
        raise LareError("--base-url is for a live model: say which one with --model NAME")
    if model is None:
        return None
    if model.endswith(".json"):
        return recorded_model(task, "factors", 0, Path(model))
    return LiveModel(model, base_url, None, Budget(REQUESTS, BUDGET), said=progress)


def evaluate(
    run: RunDirectory, episodes: int = 10, best: bool = False, deterministic: bool = False, video: Path | None = None
) -> None:
    """Evaluate the policy of a run by its true return, from initial states that no evaluation of the run has used.

    Prints the mean return of the policy with its standard deviation, and the same of as many episodes of random actions, at
    least ten (fewer if they take long), from other initial states than the policy's.

    Args:
        run: a run directory.
        episodes: number of episodes for each seed. Policies act as in training's evaluations.
        best: play the policy of each seed's best evaluation, instead of the last policy.
        deterministic: always take the most likely action, where training's evaluations sample it (ppo with choices, ippo).
        video: a .gif to write of one episode of the first seed (.mp4 with the extra lare-rl[video]).
    """
    import numpy as np

    from lare_rl.algorithms.table import ALGORITHMS
    from lare_rl.compare.statistics import in_words, plus_minus
    from lare_rl.envs.families import env_spec
    from lare_rl.evaluation.evaluate import RANDOM_EPISODES, above_chance, evaluation_of, random_play
    from lare_rl.evaluation.video import check_video, record_video
    from lare_rl.runs.directory import open_run
    from lare_rl.training.explain import explanation_of
    from lare_rl.training.session import load_actor

    opened = open_run(run)
    if video is not None:
        check_video(video)
        if env_spec(opened.config.task).agents == 1:
            draw_without_a_screen()
            progress("filming an episode; without a graphics card that may take minutes")
        record_video(opened, video, best, deterministic)
        say(f"wrote {video}")
    found = evaluation_of(opened, episodes, best, deterministic)
    since = load_actor(opened, of_best=True)[2] if best else None
    counted = f"{episodes} episodes" if episodes != 1 else "1 episode"
    roles = opened.config.task.roles
    for team, role in enumerate(roles):
        for place, seed in enumerate(opened.seeds):
            named = f"{role.name}, " if len(roles) > 1 else ""
            of_seed, summed = (in_words(each[place, :, team]) for each in (found.returns, found.sums))
            of_best = "" if since is None else f" ({when_saved(int(since[place]), opened.config.settings.warmup)})"
            of_all = f"; summed over the agents {summed}" if env_spec(opened.config.task).agents > 1 else ""
            say(f"{named}seed {seed}: return {of_seed} over {counted}{of_best}{of_all}")
    by_chance = random_play(opened.config.task, max(episodes, RANDOM_EPISODES)) if len(roles) == 1 else []
    if by_chance:
        returns = np.array([one.total for one in by_chance])
        say(f"random actions: return {in_words(returns)} over {len(by_chance)} episodes")
        if (difference := above_chance(found.returns[:, :, 0], returns)) is not None:
            say(f"difference: {plus_minus(*difference)} (± is its standard error)")
    if not (
        deterministic or ALGORITHMS[opened.config.settings.algorithm].greedy(env_spec(opened.config.task).discrete)
    ):
        say("The policy samples its actions, as in training; --deterministic plays the most likely ones.")
    for name, values in found.measures.items():
        for seed, of_seed in zip(opened.seeds, values, strict=True):
            say(f"seed {seed}: {name} {in_words(of_seed)}")
        if by_chance:
            of_chance = np.array([one.measures[name] for one in by_chance])
            say(f"random actions: {name} {in_words(of_chance)}")
    if told := explanation_of(opened):
        say(f"Credit, judged on the stored training episodes of seed {opened.seeds[0]}:")
    for line in told:
        say(line)


def when_saved(step: int, warmup: int) -> str:
    """The step of a policy, and whether it had been trained by then."""
    return f"the policy of step {step:,}{', before its first update' if step <= warmup else ''}"


def draw_without_a_screen() -> None:
    """Let MuJoCo render without a screen."""
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        os.environ.setdefault("MUJOCO_GL", "egl")


def report(runs: RunDirectories, out: Path | None = None, film: bool = False) -> None:
    """Draw a report of one or more runs: one self-contained HTML file.

    Args:
        runs: run directories, or directories that contain some, such as that of a sweep; their learning curves are drawn in one
            chart, named by method.
        out: the file to write; the default is report.html in the (first) run's directory.
        film: film an episode of each run too, and show it in the page. Without a graphics card that may take minutes.
    """
    from lare_rl.report.report import write_report
    from lare_rl.runs.directory import read_config
    from lare_rl.runs.discover import run_directories
    from lare_rl.tasks.trust import TRUSTED, unknown_module

    if film:
        draw_without_a_screen()
    found = run_directories(runs)
    unknown = sorted({one for run in found if (one := unknown_module(read_config(run).task)) is not None})
    usual = found[0] / "report.html"
    if unknown and out is None and usual.exists():
        raise LareError(
            f"{usual} would be replaced by a page without random play, credit and factors, because the module {unknown[0]} is not "
            f"imported: set {TRUSTED}={','.join(unknown)}, or write another file with --out"
        )
    progress("drawing, which takes up to a minute for each run")
    say(f"wrote {write_report(found, out, film)}")
    for module in unknown:
        progress(
            f"the module {module} was not imported, so random play, credit and factors are left out: set {TRUSTED}={module} to "
            "allow the import"
        )


def export(
    run: RunDirectory,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    seed: int | None = None,
    best: bool = False,
) -> None:
    """Write policy and rewards for programs that have neither LaRe nor JAX.

    Both are written as NumPy arrays with a loader and, with the extra lare-rl[onnx], as ONNX.

    Args:
        run: a run directory.
        out: the directory to write, which must not exist.
        seed: the seed whose policy and decoder are written; the default is the first.
        best: write the policy of the seed's best evaluation, instead of the last policy. Proxy rewards are always the last ones.
    """
    import lare_rl
    from lare_rl.runs.directory import open_run

    found = lare_rl.export(open_run(run), out, seed, best)
    say(f"wrote {', '.join(found.functions)} to {found.directory}; exported.py there says how to call them")
    if found.left_out:
        progress(f"there is no reward function: {found.left_out}")
    if not found.onnx:
        progress(f"without the package onnx, no .onnx files were written: {pip_install('onnx')}")


def cross_play(
    first: RunDirectory,
    second: RunDirectory,
    episodes: int = 200,
) -> None:
    """Let the first team of each of two runs play against the second team of each, every seed against every seed.

    Prints the first team's return, mean and standard deviation over the pairs of seeds.

    Args:
        first: a run of a task in which two teams learn, such as CompetitivePP-6.
        second: another run of the same task.
        episodes: number of episodes for each pair of seeds.
    """
    from lare_rl.compare.statistics import in_words
    from lare_rl.evaluation.team_matches import Match
    from lare_rl.evaluation.team_matches import cross_play as play
    from lare_rl.runs.directory import open_run

    runs = open_run(first), open_run(second)
    matches = play(runs, episodes)
    task = runs[0].config.task
    ours, theirs = (role.team for role in task.teams)

    def cell(match: Match) -> str:
        return in_words(match.returns.ravel())

    rows = zip((first, second), (matches[:2], matches[2:]), strict=True)
    head = (f"{ours} of, against {theirs} of", str(first), str(second))
    show(head, ((str(name), *map(cell, row)) for name, row in rows))
    say(
        f"Returns of the {ours} team: mean ± standard deviation over all pairs of a seed of one run and a seed of the other, "
        f"{episodes} episodes each."
    )

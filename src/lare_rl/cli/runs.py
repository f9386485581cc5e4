"""The commands for runs: `train`, `evaluate`, `report`, `export` and `cross-play`."""

import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import Positional

from lare_rl.cli.terminal import (
    EpisodeProgress,
    RunDirectories,
    RunDirectory,
    print_line,
    print_progress,
    print_table,
)
from lare_rl.config.effective import unused_settings
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.errors import LareError, install_command
from lare_rl.runs.plan import RunPlan, load_config
from lare_rl.util.variables import read_variable

if TYPE_CHECKING:
    from lare_rl.envs.play import Episode
    from lare_rl.latent.function import LatentFunction
    from lare_rl.runs.directory import Run
    from lare_rl.tasks.spec import TaskSpec
    from lare_rl.training.evaluation import Evaluation
    from lare_rl.training.progress import Listener

DEFAULTS = Settings()


def train(
    task: Annotated[Positional[str | None], tyro.conf.arg(metavar="[TASK]")] = None,
    settings: Annotated[Settings, tyro.conf.arg(name="")] = DEFAULTS,
    function: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="FILE")] = (),
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    resume: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    tensorboard: bool = False,
    wandb: Annotated[str | None, tyro.conf.arg(metavar="PROJECT")] = None,
    mlflow: Annotated[str | None, tyro.conf.arg(metavar="EXPERIMENT")] = None,
    watch: bool = False,
) -> None:
    """Train on a task's episodic rewards. Ctrl-C saves and stops; --resume continues.

    The help lists the hyperparameters of an algorithm if it is named, as in lare-rl train --algorithm ppo --help.

    Args:
        task: a shipped name (see `lare-rl tasks`), or the path of a task file. Not given with --resume.
        function: a latent function (.py), or a reply with one (.json), to use instead of a recorded one; verified before it is
            run. Where several teams learn, one --function for each, in the order of the task.
        out: the run directory, which must not exist; the default is runs/TASK-METHOD-ALGORITHM-sSEED.
        config: a TOML or JSON file with task, function, out and any of the settings, or the directory of a run to repeat. The options of
            the command line win.
        resume: a run directory to continue, from its last checkpoint and with its own settings. With --steps, a finished run is
            extended.
        tensorboard: write TensorBoard events into the run directory too (needs the extra lare-rl[tensorboard]).
        wandb: send the metrics of each seed to a project of Weights & Biases too (needs the extra lare-rl[wandb]).
        mlflow: send the metrics of each seed to an experiment of MLflow too (needs the extra lare-rl[mlflow]).
        watch: write verdict and curves to watch.html in the run directory after every evaluation, and open it in the browser.
    """
    plan = RunPlan(None, DEFAULTS, None, None) if config is None else load_config(config)
    chosen_task = task or plan.task
    if isinstance(chosen_task, str):
        from lare_rl.envs.load import read_task

        read_task(chosen_task)  # a typo is reported before the slow imports
    import lare_rl
    from lare_rl.runs.directory import open_run

    if resume is not None:
        options = (task, function, out, config, settings.model_copy(update={"steps": None}))
        if options != (None, (), None, None, DEFAULTS):
            raise LareError("--resume uses the run's settings: give it no task, and no setting but --steps")
        run_settings = open_run(resume).config.settings
        listeners = [*_listeners(wandb, mlflow, run_settings), *_live_page(resume, watch)]
        run = lare_rl.resume(resume, steps=settings.steps, tensorboard=tensorboard, listeners=listeners)
    elif chosen_task is None:
        raise LareError(
            f"there is no task{'' if config is None else f' in {config}'}: use lare-rl train TASK (lare-rl tasks lists them), "
            "or lare-rl train --resume DIR"
        )
    else:
        from lare_rl.config.resolve import resolve
        from lare_rl.envs.load import resolve_task
        from lare_rl.runs.directory import default_directory

        spec = resolve_task(chosen_task)
        resolved = resolve(settings, spec)
        for name, warning in unused_settings(settings, resolved, spec).items():
            if not (plan.is_run and plan.has(name, settings)):
                raise LareError(f"{warning}: leave the setting out")
        planned = plan.function_for(resolved)
        functions = _load_functions(function or planned, spec, resolved) if function or planned else None
        out = out or plan.out or default_directory(spec, resolved)
        run = lare_rl.train(
            spec,
            settings,
            function=functions,
            out=out,
            tensorboard=tensorboard,
            listeners=[*_listeners(wandb, mlflow, resolved), *_live_page(out, watch)],
        )
    print_line(f"finished {run.directory}; to see it: lare-rl report {run.directory}")


def _load_functions(
    files: "Sequence[Path | LatentFunction]", spec: "TaskSpec", resolved: ResolvedSettings
) -> "list[LatentFunction]":
    """Load and verify the latent functions of a run."""
    from lare_rl.latent.function import CHANGED_SUFFIX, pair_with_roles
    from lare_rl.latent.saved import load_function
    from lare_rl.training.latent_functions import check_draw_unused

    check_draw_unused(resolved)
    functions = [
        load_function(file, role) if isinstance(file, Path) else file for file, role in pair_with_roles(files, spec)
    ]
    for function in functions:
        if function.changed:
            author = function.model.removesuffix(CHANGED_SUFFIX)
            print_progress(f"the function by {author} was changed after it was saved: its hash differs")
    return functions


def _listeners(wandb: str | None, mlflow: str | None, settings: ResolvedSettings) -> "list[Listener]":
    """Return the terminal, and the requested tracking services."""
    from lare_rl.training.progress import Terminal
    from lare_rl.training.trackers import MLflow, WeightsAndBiases

    listeners: list[Listener] = [Terminal()]
    config = settings.model_dump(mode="json")
    if wandb is not None:
        listeners.append(WeightsAndBiases(project=wandb, config=config))
    if mlflow is not None:
        listeners.append(MLflow(mlflow, parameters=config))
    return listeners


def _live_page(directory: Path, watch: bool) -> "list[Listener]":
    """Return the page that shows the run, if it is requested now, or was requested before the run was stopped."""
    if not watch and not directory.exists():
        return []
    from lare_rl.report.live_page import PAGE, LivePage

    page = directory / PAGE
    if watch:
        print_progress(f"to watch it: {page}")
    return [LivePage(directory, browser=watch)] if watch or page.exists() else []


def evaluate(
    run: RunDirectory, episodes: int = 10, best: bool = False, deterministic: bool = False, video: Path | None = None
) -> None:
    """Evaluate the policy of a run by its true return, from initial states that no evaluation of the run has used.

    Prints the mean return of the policy with its standard deviation, and the same of as many episodes of random actions, at
    least ten (at least five if they take longer than the policy's), from other initial states, and the difference with its
    standard error. A policy that samples its actions also plays the most likely ones.

    Args:
        run: a run directory.
        episodes: number of episodes for each seed. Policies act as in training's evaluations.
        best: play the policy of each seed's best evaluation, instead of the last policy.
        deterministic: always take the most likely action, where training's evaluations sample it (ppo with choices, ippo).
        video: a .gif to write of one episode of the first seed (.mp4 with the extra lare-rl[video]).
    """
    from lare_rl.algorithms.registry import ALGORITHMS
    from lare_rl.envs.families import load_env_spec
    from lare_rl.evaluation.evaluate import RANDOM_EPISODES, RANDOM_PLAY_LIMIT_S, evaluate_policy, play_random
    from lare_rl.evaluation.video import check_video_path, record_video
    from lare_rl.runs.directory import open_run
    from lare_rl.training.explain import explain_run
    from lare_rl.training.saved_state import load_actor

    opened = open_run(run)
    task, settings = opened.config.task, opened.config.settings
    env_spec = load_env_spec(task)
    if video is not None:
        check_video_path(video)
        if env_spec.n_agents == 1:
            _render_without_screen()
            print_progress("filming an episode; without a graphics card that may take minutes")
        record_video(opened, video, best, deterministic)
        print_line(f"wrote {video}")
    start = time.monotonic()
    evaluation = evaluate_policy(opened, episodes, best, deterministic, EpisodeProgress(episodes))
    policy_s, n_random = time.monotonic() - start, max(episodes, RANDOM_EPISODES)
    samples = not (deterministic or ALGORITHMS[settings.algorithm].greedy(env_spec.discrete))
    likeliest = evaluate_policy(opened, episodes, best, True, EpisodeProgress(episodes)) if samples else None
    best_steps = load_actor(opened, best=True)[2].tolist() if best else None
    random_episodes = []
    if len(task.roles) == 1:
        random_episodes = play_random(task, n_random, max(policy_s, RANDOM_PLAY_LIMIT_S), EpisodeProgress(n_random))
    for line in _describe_evaluation(opened, evaluation, random_episodes, best_steps):
        print_line(line)
    if likeliest is not None:
        print_line(
            "The policy samples its actions, as in training. The most likely ones (--deterministic), from the same states:"
        )
        for line in _describe_returns(opened, likeliest, best_steps):
            print_line(line)
    if explanation := explain_run(opened):
        print_line(f"Credit, judged on the stored training episodes of seed {opened.seeds[0]}:")
    for line in explanation:
        print_line(line)


def _describe_returns(run: "Run", evaluation: "Evaluation", best_steps: "Sequence[int] | None") -> Iterator[str]:
    """Yield the returns of each seed. `best_steps` are the steps of the best policies."""
    from lare_rl.envs.families import load_env_spec
    from lare_rl.util.findings import format_value
    from lare_rl.util.statistics import format_mean_std

    roles, has_many_agents = run.config.task.roles, load_env_spec(run.config.task).n_agents > 1
    for team_index, role in enumerate(roles):
        for seed_index, seed in enumerate(run.seeds):
            returns = evaluation.returns[seed_index, :, team_index]
            line = f"{role.name}, " if len(roles) > 1 else ""
            line += f"seed {seed}: return {format_mean_std(returns)} over {format_value(len(returns), 'count episode')}"
            if best_steps is not None:
                step = best_steps[seed_index]
                untrained = ", before its first update" if step <= run.config.settings.warmup else ""
                line += f" (the policy of step {step:,}{untrained})"
            if has_many_agents:
                sums = evaluation.summed_returns[seed_index, :, team_index]
                line += f"; summed over the agents {format_mean_std(sums)}"
            yield line


def _describe_evaluation(
    run: "Run", evaluation: "Evaluation", random_episodes: "Sequence[Episode]", best_steps: "Sequence[int] | None"
) -> Iterator[str]:
    """Yield the returns and measures of each seed, and of random actions. `best_steps` are the steps of the best policies."""
    import numpy as np

    from lare_rl.evaluation.evaluate import gain_over_random
    from lare_rl.util.findings import format_value
    from lare_rl.util.statistics import format_mean_std, format_plus_minus

    yield from _describe_returns(run, evaluation, best_steps)
    if random_episodes:
        returns = np.array([episode.return_ for episode in random_episodes])
        yield f"random actions: return {format_mean_std(returns)} over {format_value(len(returns), 'count episode')}"
        if (gain := gain_over_random(evaluation.returns[:, :, 0], returns)) is not None:
            yield f"difference: {format_plus_minus(*gain)} (± is its standard error)"
    for name, seed_values in evaluation.measures.items():
        for seed, values in zip(run.seeds, seed_values, strict=True):
            yield f"seed {seed}: {name} {format_mean_std(values)}"
        if random_episodes:
            values = np.array([episode.measures[name] for episode in random_episodes])
            yield f"random actions: {name} {format_mean_std(values)}"


def _render_without_screen() -> None:
    """Let MuJoCo render without a screen."""
    if sys.platform == "linux" and not (read_variable("DISPLAY") or read_variable("WAYLAND_DISPLAY")):
        os.environ.setdefault("MUJOCO_GL", "egl")


def report(runs: RunDirectories, out: Path | None = None, film: bool = True) -> None:
    """Draw a report of one or more runs: one self-contained HTML file.

    Args:
        runs: run directories, or directories that contain some, such as that of a sweep; their learning curves are drawn in one
            chart, named by method.
        out: the file to write; the default is report.html in the (first) run's directory.
        film: show a film of the policy, or of the best of many, where its environment can be drawn.
    """
    from lare_rl.report.report import write_report
    from lare_rl.runs.config_file import read_config
    from lare_rl.runs.directory import find_run_directories
    from lare_rl.tasks.trust import TRUST_VARIABLE, untrusted_module

    if film:
        _render_without_screen()
    directories = find_run_directories(runs)
    modules = {untrusted_module(read_config(directory).task) for directory in directories} - {None}
    untrusted = ",".join(sorted(map(str, modules)))
    default_path = directories[0] / "report.html"
    if untrusted and out is None and default_path.exists():
        raise LareError(
            f"{default_path} would lose random play, credit and factors, because {untrusted} is not imported: set "
            f"{TRUST_VARIABLE}={untrusted} to allow the import, or write another file with --out"
        )
    print_progress("drawing, which takes up to a minute for each run")
    print_line(f"wrote {write_report(directories, out, film)}")
    if untrusted:
        print_progress(
            f"random play, credit and factors are left out, because {untrusted} was not imported: set {TRUST_VARIABLE}={untrusted} "
            "to allow the import"
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

    result = lare_rl.export_run(open_run(run), out, seed, best)
    print_line(f"wrote {', '.join(result.functions)} to {result.directory}; exported.py there says how to call them")
    if result.no_reward_reason:
        print_progress(f"there is no reward function: {result.no_reward_reason}")
    if not result.onnx:
        print_progress(f"without the package onnx, no .onnx files were written: {install_command('onnx')}")


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
    from lare_rl.evaluation.cross_play import cross_play as play
    from lare_rl.runs.directory import open_run
    from lare_rl.util.statistics import format_mean_std

    runs = open_run(first), open_run(second)
    cells = [format_mean_std(match.returns.ravel()) for match in play(runs, episodes)]
    first_team, second_team = (role.team for role in runs[0].config.task.teams)
    head = (f"{first_team} of, against {second_team} of", str(first), str(second))
    print_table(head, [(str(first), *cells[:2]), (str(second), *cells[2:])])
    print_line(
        f"Returns of the {first_team} team: mean ± standard deviation over all pairs of a seed of one run and a seed of the other, "
        f"{episodes} episodes each."
    )

"""The commands for trained runs: `evaluate`, `report`, `export` and `cross-play`."""

import math
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from lare_rl.cli.terminal import (
    EpisodeProgress,
    RunDirectories,
    RunDirectory,
    print_line,
    print_progress,
    print_table,
)
from lare_rl.errors import LareError, install_command
from lare_rl.util.variables import read_variable

if TYPE_CHECKING:
    from lare_rl.envs.play import Episode
    from lare_rl.runs.directory import Run
    from lare_rl.training.evaluation import Evaluation


def evaluate(
    run: RunDirectory,
    episodes: int = 10,
    best: bool = False,
    deterministic: bool = False,
    environment: str | None = None,
    video: Path | None = None,
) -> None:
    """Evaluate the policy of a run by its true return, from initial states that no evaluation of the run has used.

    Prints the mean return of the policy with its standard deviation, and the same of as many episodes of random actions, at
    least ten (at least five if they take longer than the policy's), from other initial states, and the difference with its
    standard error. If the task has groups, random actions play from the same initial states as the policy. A policy that samples
    its actions also plays the most likely ones.

    Args:
        run: a run directory.
        episodes: number of episodes for each seed. Policies act as in training's evaluations.
        best: play the policy of each seed's best evaluation, instead of the last policy.
        deterministic: always take the most likely action, where training's evaluations sample it (ppo with choices, ippo).
        environment: play in this environment, of the same module and with the same sizes (other maps, years or demand). By default
            that of the run's evaluations.
        video: a .gif to write of one episode of the first seed (.mp4 with the extra lare-rl[video]).
    """
    from lare_rl.algorithms.registry import ALGORITHMS
    from lare_rl.envs.families import load_env_spec
    from lare_rl.evaluation.evaluate import (
        RANDOM_EPISODES,
        RANDOM_PLAY_LIMIT_S,
        evaluate_policy,
        evaluation_seeds,
        move_evaluations,
        play_random,
    )
    from lare_rl.evaluation.video import check_video_path, record_video
    from lare_rl.runs.directory import open_run
    from lare_rl.training.explain import explain_run
    from lare_rl.training.saved_state import load_actor

    opened = move_evaluations(open_run(run), environment)
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
    samples = not (deterministic or ALGORITHMS[settings.algorithm].deterministic_evaluation(env_spec.discrete))
    likeliest = evaluate_policy(opened, episodes, best, True, EpisodeProgress(episodes)) if samples else None
    best_steps = load_actor(opened, best=True)[2].tolist() if best else None
    seeds = [] if task.group is None else evaluation_seeds(opened, episodes)
    if seeds:  # each equally often, because groups may differ in their returns
        n_random = len(seeds) * math.ceil(RANDOM_EPISODES / len(seeds))
    limit_s = max(policy_s, RANDOM_PLAY_LIMIT_S)
    random_episodes = play_random(task, n_random, limit_s, EpisodeProgress(n_random), seeds)
    for line in _describe_evaluation(opened, evaluation, random_episodes, best_steps):
        print_line(line)
    if 0 < len(random_episodes[0]) < n_random:
        print_line(f"random actions ended after {len(random_episodes[0])} of {n_random} episodes, to save time")
    if likeliest is not None:
        print_line(
            "The policy samples its actions, as in training. The most likely ones (--deterministic), from the same states:"
        )
        for line in _describe_returns(opened, likeliest, best_steps):
            print_line(line)
        for line in _compare_actions(opened, evaluation, likeliest):
            print_line(line)
    if explanation := explain_run(opened):
        print_line(f"Credit, judged on the stored training episodes of seed {opened.seeds[0]}:")
    for line in explanation:
        print_line(line)


def _describe_returns(run: "Run", evaluation: "Evaluation", best_steps: "Sequence[int] | None") -> Iterator[str]:
    """Yield the returns of each seed. `best_steps` are the steps of the best policies."""
    from lare_rl.envs.families import load_env_spec
    from lare_rl.util.findings import format_for_reader
    from lare_rl.util.statistics import format_mean_std

    roles, has_many_agents = run.config.task.roles, load_env_spec(run.config.task).n_agents > 1
    for team_index, role in enumerate(roles):
        for seed_index, seed in enumerate(run.seeds):
            returns = evaluation.returns[seed_index, :, team_index]
            line = f"{role.name}, " if len(roles) > 1 else ""
            line += f"seed {seed}: return {format_mean_std(returns)} over {format_for_reader(len(returns), 'count episode')}"
            if best_steps is not None:
                step = best_steps[seed_index]
                untrained = ", before its first update" if step <= run.config.settings.warmup else ""
                line += f" (the policy of step {step:,}{untrained})"
            if has_many_agents:
                sums = evaluation.summed_returns[seed_index, :, team_index]
                line += f"; summed over the agents {format_mean_std(sums)}"
            yield line


def _compare_actions(run: "Run", sampled: "Evaluation", likeliest: "Evaluation") -> Iterator[str]:
    """Say which actions are better, if that is clear. Both evaluations play from the same initial states."""
    from lare_rl.evaluation.evaluate import mean_with_error
    from lare_rl.report.score_use import CLEAR_ERRORS
    from lare_rl.util.statistics import format_plus_minus

    for i, role in enumerate(run.config.task.roles):
        gain = mean_with_error((likeliest.returns - sampled.returns)[:, :, i])
        if gain is not None and abs(gain[0]) > CLEAR_ERRORS * gain[1]:
            verdict = "better: use deterministic=True in load_policy" if gain[0] > 0 else "worse: let the policy sample"
            yield f"{role.name}: the most likely actions are {verdict} ({format_plus_minus(*gain)})"


def _describe_evaluation(
    run: "Run",
    evaluation: "Evaluation",
    random_episodes: "Sequence[Sequence[Episode]]",
    best_steps: "Sequence[int] | None",
) -> Iterator[str]:
    """Yield the returns and measures of each seed, and of random actions. `best_steps` are the steps of the best policies."""
    import numpy as np

    from lare_rl.evaluation.evaluate import gain_over_random
    from lare_rl.util.findings import format_for_reader
    from lare_rl.util.statistics import format_mean_std, format_plus_minus

    task = run.config.task
    if task.evaluation_environment is not None:
        yield f"in {task.evaluation_environment} (training was in {task.environment}):"
    yield from _describe_returns(run, evaluation, best_steps)
    roles = task.roles
    for team_index, (role, episodes) in enumerate(zip(roles, random_episodes, strict=True)):
        if not episodes:
            continue
        team = f"{role.name}, " if len(roles) > 1 else ""
        returns = np.array([episode.return_ for episode in episodes])
        yield f"{team}random actions: return {format_mean_std(returns)} over {format_for_reader(len(returns), 'count episode')}"
        if (gain := gain_over_random(evaluation.returns[:, :, team_index], returns)) is not None:
            yield f"{team}difference: {format_plus_minus(*gain)} (± is its standard error)"
    if (group := task.group) is not None and random_episodes[0]:
        groups = Counter(np.asarray(evaluation.measures[group]).ravel().tolist())
        random_groups = Counter(episode.measures[group] for episode in random_episodes[0])
        if any(groups[name] * random_groups.total() != count * groups.total() for name, count in random_groups.items()):
            yield f"random actions played other groups ({group}), or in other shares, which is a part of the difference"
    for name, seed_values in evaluation.drop_group(task).measures.items():
        for seed, values in zip(run.seeds, seed_values, strict=True):
            yield f"seed {seed}: {name} {format_mean_std(values)}"
        if random_episodes[0]:
            values = np.array([episode.measures[name] for episode in random_episodes[0]])
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

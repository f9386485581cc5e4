"""The commands for trained runs: `evaluate`, `report`, `export` and `cross-play`."""

import os
import sys
from pathlib import Path
from typing import Annotated

import tyro

from lare_rl.cli.terminal import EpisodeProgress, RunDirectories, RunDirectory, print_line, print_progress, print_table
from lare_rl.errors import LareError, install_command
from lare_rl.util.variables import read_variable


def evaluate(
    run: RunDirectory,
    episodes: int = 10,
    best: bool = False,
    deterministic: bool = False,
    environment: str | None = None,
    video: Path | None = None,
) -> None:
    """Evaluate the policy of a run by its true return, from initial states that no evaluation of the run has used.

    Prints the mean return of the policy and of random actions, with their standard deviations, and the difference with its standard
    error. Random actions are played for as many episodes, but at least ten; fewer where they are slow. In an environment in Python they
    start from the same initial states. A policy that samples its actions also plays the most likely ones.

    Args:
        run: a run directory.
        episodes: number of episodes for each seed. Policies act as in training's evaluations.
        best: play the policy of each seed's best evaluation, instead of the last policy.
        deterministic: always take the most likely action, where training's evaluations sample it (ppo with choices, ippo).
        environment: play in this environment, of the same module and with the same sizes (other maps, years or demand). By default
            that of the run's evaluations.
        video: a .gif to write of one episode of the first seed (.mp4 with the extra lare-rl[video]).
    """
    from lare_rl.envs.placement import load_env_spec
    from lare_rl.evaluation.evaluate import move_evaluations
    from lare_rl.evaluation.video import check_video_path, record_video
    from lare_rl.report.evaluation_lines import evaluation_lines
    from lare_rl.runs.directory import open_run
    from lare_rl.training.explain import explain_run

    opened = move_evaluations(open_run(run), environment)
    if video is not None:
        check_video_path(video)
        if load_env_spec(opened.config.task).n_agents == 1:
            _render_without_screen()
            print_progress("filming an episode; without a graphics card that may take minutes")
        record_video(opened, video, best, deterministic)
        print_line(f"wrote {video}")
    for line in evaluation_lines(opened, episodes, best, deterministic, EpisodeProgress):
        print_line(line)
    if explanation := explain_run(opened):
        print_line(f"Credit, judged on the stored training episodes of seed {opened.seeds[0]}:")
    for line in explanation:
        print_line(line)


def _render_without_screen() -> None:
    """Let MuJoCo render without a screen."""
    if sys.platform == "linux" and not (read_variable("DISPLAY") or read_variable("WAYLAND_DISPLAY")):
        os.environ.setdefault("MUJOCO_GL", "egl")


def report(runs: RunDirectories, out: Path | None = None, film: bool = True) -> None:
    """Draw a report of one or more runs: one self-contained HTML file.

    Args:
        runs: run directories, or directories that contain some, such as that of a sweep; their learning curves are drawn in one
            chart, named by method.
        out: the file to write; the default is report.html, in the run's directory or, for several runs, in the current one.
        film: show a film of the policy, or of the best of many, where its environment can be drawn.
    """
    from lare_rl.report.report import default_path, write_report
    from lare_rl.runs.config_file import read_config
    from lare_rl.runs.directory import find_run_directories
    from lare_rl.tasks.trust import TRUST_VARIABLE, untrusted_module

    if film:
        _render_without_screen()
    directories = find_run_directories(runs)
    modules = {untrusted_module(read_config(directory).task) for directory in directories} - {None}
    untrusted = ",".join(sorted(map(str, modules)))
    remedy = f"set {TRUST_VARIABLE}={untrusted} to allow the import"
    path = out or default_path(directories)
    if untrusted and out is None and path.exists():
        raise LareError(
            f"the new {path} would have no random play, credit and factors, because {untrusted} is not imported: {remedy}, or write "
            "another file with --out"
        )
    print_progress("drawing, which takes up to a minute for each run")
    print_line(f"wrote {write_report(directories, path, film)}")
    if untrusted:
        print_progress(f"random play, credit and factors are left out, because {untrusted} was not imported: {remedy}")


def export(
    run: RunDirectory, out: Annotated[Path, tyro.conf.arg(metavar="DIR")], seed: int | None = None, best: bool = False
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


def cross_play(first: RunDirectory, second: RunDirectory, episodes: int = 200) -> None:
    """Let the teams of two runs play against each other: the first team of each run against the second team of each.

    Each match is played for every pair of seeds. Prints the first team's return, mean and standard deviation over the pairs.

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
    head = (f"{first_team} (rows) against {second_team}", str(first), str(second))
    print_table(head, [(str(first), *cells[:2]), (str(second), *cells[2:])])
    print_line(
        f"Returns of the {first_team} team: mean ± standard deviation over all pairs of a seed of one run and a seed of the other, "
        f"{episodes} episodes each."
    )

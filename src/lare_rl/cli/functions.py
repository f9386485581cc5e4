"""The commands `prompt`, `new-task` and `verify`: the request to a model, your own task, and the checks of a function."""

import math
import shlex
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import tyro
from tyro.conf import Positional

from lare_rl.cli.terminal import (
    Data,
    EpisodeProgress,
    Kind,
    Task,
    TaskName,
    load_playing_policy,
    load_steps,
    print_line,
    print_messages,
    print_progress,
)
from lare_rl.errors import LareError
from lare_rl.tasks.spec import NO_ENVIRONMENT, ScoredObservation
from lare_rl.util.files import check_new_path, write_bytes
from lare_rl.util.findings import format_for_reader

if TYPE_CHECKING:
    from lare_rl.envs.play import Episode, Policy
    from lare_rl.latent.function import LatentFunction
    from lare_rl.latent.verify import Verdict
    from lare_rl.new_task.draft import Draft
    from lare_rl.tasks.spec import TaskSpec

GOOD_R2 = 0.8
"""From this R² of returns on, factors are worth training with."""


def prompt(task: Task, kind: Kind = "factors") -> None:
    """Print the request that a language model gets for a task."""
    from lare_rl.envs.load import load_task
    from lare_rl.llm.prompts import candidate
    from lare_rl.tasks.spec import require_role

    print_messages(candidate(require_role(load_task(task)), kind))


def new_task(
    environment: Annotated[Positional[str], tyro.conf.arg(metavar="ENV_ID")],
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> None:
    """Write the first draft of a task file: of an environment, from its spaces and documentation; or of a log, from its arrays.

    Sentences that speak of rewards are left out. Texts that could not be found are marked for you to fill in. If the agents
    are of several kinds, one more file is written for each kind.

    Args:
        environment: a Gymnasium id, such as Pendulum-v1 (module:id first imports the module, which registers it); or
            pettingzoo/MODULE:NAME, where NAME makes a PettingZoo ParallelEnv; or FAMILY/NAME for the JAX environments of gymnax,
            brax, playground, jumanji and jaxmarl, such as gymnax/CartPole-v1; or logged episodes, which are a directory, a
            Parquet file, or the id of a local Minari data set.
        out: the file to write, which must not exist; the default is the task's name with .toml.
    """
    from lare_rl.new_task.draft import LIMIT_LINE

    draft = _draft(environment)
    path = out or Path(f"{draft.name}.toml")
    paths = [path, *(path.parent / name for name in draft.teams)]
    if path in paths[1:]:
        raise LareError(f"{path} is the file of a team; choose another --out")
    for new in paths:
        check_new_path(new, "--out" if new == path else "folder for --out")
    for new, text in zip(paths, [draft.toml, *draft.teams.values()], strict=True):
        write_bytes(new, text.encode())
    print_line(f"wrote {', '.join(map(str, paths))}")
    print_line("  its first lines say what was left out, if anything")
    if LIMIT_LINE in draft.toml:
        print_line("  max_episode_steps is a guess: write the length of the longest episode, or more")
    where = f" of {', '.join(map(str, paths))}" if draft.teams else ""
    for key in draft.missing_keys:
        print_line(
            f"  fill in: {key}{where} ({'the log' if draft.logs_only else 'the environment'} does not document it)"
        )
    data = ["--data", environment] if draft.logs_only else []
    roles = [(str(file), f"phi_{file.stem}.py") for file in paths[1:]] or [(str(path), "phi.py")]
    for role_path, function_path in roles:
        design = shlex.join(["lare-rl", "design", role_path, *data, "--model", "NAME", "--out", function_path])
        print_line(f"read it, then: {design}")
    without_function = "lare-rl relabel without --function" if draft.logs_only else "--method bayes"
    print_line(
        f"or, without a model: paste the output of lare-rl prompt {shlex.quote(roles[0][0])} into a chat, or write phi.py yourself, with "
        f"a function evaluation_func(observation, action) (docs/how-to/write-phi.md); {without_function} needs no phi.py, and none of "
        "the texts"
    )


def _draft(source: str) -> "Draft":
    """Draft the task of an environment, or of a log."""
    from lare_rl.new_task.single_agent import draft_task

    if not Path(source).exists():
        try:
            return draft_task(source)
        except LareError:
            if find_spec("minari") is None:
                raise
            from lare_rl.logs.minari import is_local_dataset

            if not is_local_dataset(source):
                raise
    from lare_rl.logs.draft_from_log import draft_log_task

    return draft_log_task(source)


def verify(
    file: Annotated[Positional[Path], tyro.conf.arg(metavar="FILE")],
    task: TaskName,
    kind: Kind = "factors",
    data: Data = None,
    fit: int = 0,
    policy: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None,
    scored_observation: ScoredObservation | None = None,
) -> None:
    """Verify a function: it is read, never executed, and its factors must be finite. Prints the entries that each factor reads.

    With --fit, also print how much of the returns of some episodes its factors explain, and how much each factor contributes.

    Exit status 0: it passes. 1: it does not, and every reason is printed. 2: it could not be checked.

    Args:
        file: Python source, a function that `lare-rl design` saved, or a model's reply to the request of `lare-rl prompt` (.json).
        fit: number of episodes, 20 or more, whose returns the factors are fitted to: the first of --data, or episodes that are
            played with random actions, the same in every call.
        policy: a run whose policy plays the episodes for --fit, instead of random actions.
        scored_observation: the observation of a step that the function reads, instead of the task's.
    """
    from lare_rl.envs.load import load_task, read_task
    from lare_rl.tasks.spec import require_role

    read_task(task)  # a typo is reported before the slow imports
    from lare_rl.credit.explanation_text import MIN_EXPLAINED_EPISODES
    from lare_rl.latent.function import function_from_verdict
    from lare_rl.latent.saved import read_source
    from lare_rl.latent.verify import verify as verify_source

    source, changed, saved_task = read_source(file)
    if fit and fit < MIN_EXPLAINED_EPISODES:
        raise LareError(f"fit = {fit}: at least {MIN_EXPLAINED_EPISODES} episodes are needed")
    if policy is not None and (not fit or data is not None):
        raise LareError("--policy plays the episodes for --fit: give --fit a number of episodes, and no --data")
    spec = load_task(task) if data is None else read_task(task)
    if scored_observation is not None:
        spec = spec.model_copy(update={"scored_observation": scored_observation})
    play, role = load_playing_policy(policy, spec), require_role(spec)
    if changed:
        print_line("note    the source was changed after it was saved: its hash differs")
    if saved_task not in (None, role.name):
        print_line(f"note    it was written for the task {saved_task!r}")
    verdict = verify_source(source, spec, kind, load_steps(data, spec))
    print_line(f"for {role.name}: observations of {role.observation_size} numbers, actions of {role.action_size}")
    _print_verdict(verdict)
    if not verdict.passed:
        if file.suffix == ".json":
            print_line("Paste the lines after FAILED into the same chat, and ask for the whole reply again, corrected.")
        sys.exit(1)
    function = function_from_verdict(source, role, kind, verdict)
    for name, reads in zip(function.names, function.reads, strict=True):
        print_line(f"factor  {name} reads {reads}")
    if fit:
        _print_assessment(function, role, _load_episodes(role, data, fit, play))


def _print_verdict(verdict: "Verdict") -> None:
    for check in verdict.checks:
        print_line(f"{'passed' if check.passed else 'FAILED'}  {check.name}")
        for line in check.message.splitlines():
            print_line(f"        {line}")
    for line in verdict.advice:
        print_line(f"advice  {line}")


def _load_episodes(role: "TaskSpec", data: str | None, n_episodes: int, policy: "Policy | None") -> Sequence["Episode"]:
    """Return episodes of a log, or of the environment."""
    if data is not None:
        from lare_rl.logs.steps import logged_episodes

        return logged_episodes(data, role, n_episodes)
    from lare_rl.envs.play import play_episodes

    print_progress(f"playing {n_episodes} episodes by {'random actions' if policy is None else 'the policy'}")
    return play_episodes(role, n_episodes, policy, on_episode=EpisodeProgress(n_episodes))


def _print_assessment(function: "LatentFunction", role: "TaskSpec", episodes: Sequence["Episode"]) -> None:
    """Print how well the factors explain the returns of some episodes."""
    from lare_rl.training.reflect import assess_function

    assessment = assess_function(function, role, episodes)
    fit = assessment.fit
    n_steps = sum(len(episode.team_reward) for episode in episodes) / len(episodes)
    n_paid = sum(int((episode.team_reward != 0).sum()) for episode in episodes) / len(episodes)
    if n_paid > 1:
        print_line(
            f"An episode pays at {n_paid:.0f} of {n_steps:.0f} steps. Its return is the sum of these rewards. If your reward is a score so "
            "far, return 0 before the end of an episode, and the score at the end."
        )
    if len({episode.return_ for episode in episodes}) == 1:
        print_line(f"All {len(episodes)} episodes have the same return, which says nothing about the factors.")
        if role.environment != NO_ENVIRONMENT:
            print_line(
                "Does the environment pay before its time limit (max_episode_steps)? If it does, let its score differ between bad "
                "episodes too: a score that is 0 for all random actions teaches nothing."
            )
        return
    if math.isfinite(fit.r2):
        r2, r2_error = format_for_reader(fit.r2, "r2"), format_for_reader(fit.r2_error, "error")
        print_line(
            f"Returns of unseen episodes, predicted by the factors: R² = {r2} (1: exactly; 0: no better than their mean), "
            f"with a standard error of {r2_error}."
        )
        if fit.r2 < GOOD_R2:
            print_line(
                _better_observation(function, role, episodes, fit.r2)
                or f"Play more episodes: if the factors are right, R² rises. If it remains below about {GOOD_R2}, phi lacks something "
                "that the score depends on, or the score is partly noise or decided by the initial state."
            )
        if fit.length_r2 is not None:
            length_r2 = format_for_reader(fit.length_r2, "r2")
            print_line(f"Predicted by the lengths of these episodes alone, without a factor: R² = {length_r2}.")
        if fit.level_r2 is not None:
            level_r2 = format_for_reader(fit.level_r2, "r2")
            print_line(
                f"Each group has an intercept in this fit. Predicted by the groups alone, without a factor: R² = {level_r2}."
            )
        print_line(
            f"Fitted to all {len(episodes)} episodes (shares may be high where R² is low, because these returns were seen):"
        )
    for line in assessment.sentences:
        print_line(line)


def _better_observation(
    function: "LatentFunction", role: "TaskSpec", episodes: Sequence["Episode"], r2: float
) -> str | None:
    """Return a sentence on the other scored observation that explains the returns best; None if none does clearly better."""
    from lare_rl.training.reflect import assess_function

    better = {}
    for name in get_args(ScoredObservation):
        if name != role.scored_observation:
            other_role = role.model_copy(update={"scored_observation": name})
            other = assess_function(function, other_role, episodes).fit
            if other.r2 - other.r2_error > r2:
                better[name] = other.r2
    if not better:
        return None
    best = max(better, key=lambda name: round(better[name], 2))  # of equally good ones the first, which is simpler
    other_r2, this_r2 = (format_for_reader(value, "r2") for value in (better[best], r2))
    return f"--scored-observation {best} explains more (R² {other_r2} instead of {this_r2}): set it in the task file."

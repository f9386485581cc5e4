"""The commands `prompt`, `new-task` and `verify`: the request to a model, your own task, and the checks of a function."""

import math
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import Positional

from lare_rl.cli.terminal import Data, Kind, Task, progress, say, steps_of, write_new
from lare_rl.errors import LareError
from lare_rl.tasks.spec import Judges

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lare_rl.envs.play import Episode, Policy
    from lare_rl.latent.function import LatentFunction
    from lare_rl.new_task.draft import Draft
    from lare_rl.tasks.spec import TaskSpec


def prompt(task: Task, kind: Kind = "factors") -> None:
    """Print the request that a language model gets for a task.

    Args:
        task: a shipped name (see `lare-rl tasks`), or the path of a task file.
        kind: what the function returns: several factors, or one reward.
    """
    from lare_rl.envs.load import load_task
    from lare_rl.llm.prompts import candidate
    from lare_rl.tasks.spec import the_role

    for message in candidate(the_role(load_task(task)), kind):
        say(f"--- {message['role']} ---\n{message['content']}\n")


def new_task(
    environment: Annotated[Positional[str], tyro.conf.arg(metavar="ENV_ID")],
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> None:
    """Write the first draft of a task file: of an environment, from its spaces and documentation; or of a log, from its arrays.

    Sentences that speak of rewards are left out. Texts that could not be found are marked for you to fill in. If the agents
    are of several kinds, one more file is written for each kind.

    Args:
        environment: a Gymnasium id, such as Pendulum-v1 (module:id first imports the module, which registers it); or
            pettingzoo/MODULE:NAME, where NAME makes a PettingZoo ParallelEnv; or logged episodes, which are a directory, a
            Parquet file, or the id of a local Minari data set.
        out: the file to write, which must not exist; the default is the task's name with .toml.
    """
    drafted = draft_of(environment)
    path = out or Path(f"{drafted.name}.toml")
    write_new(path, drafted.toml, "--out")
    for name, text in drafted.teams.items():
        write_new(path.parent / name, text, "folder for --out")
    say(f"wrote {', '.join(map(str, (path, *(path.parent / name for name in drafted.teams))))}")
    if drafted.left_out:
        say("  left out or cut short, because it seems to speak of rewards:")
    for said in drafted.left_out:
        say(f"    {said}")
    if drafted.unused:
        say(f"  sections of the documentation that were not used: {', '.join(drafted.unused)}")
    for key in drafted.missing:
        say(f"  fill in: {key} ({'the log' if drafted.of_logs else 'the environment'} does not document it)")
    data = f" --data {environment}" if drafted.of_logs else ""
    say(f"read it, then: lare-rl design {path}{data} --model NAME --out phi.py")
    none = "lare-rl relabel without --function" if drafted.of_logs else "--method bayes"
    say(
        f"or, without a model: paste the output of lare-rl prompt {path} into a chat, or write phi.py yourself, with a function "
        f"evaluation_func(observation, action) (docs/bring-your-own-task.md, 2.); {none} needs no phi.py"
    )


def draft_of(named: str) -> "Draft":
    """The first draft of a task: of an environment, or of a log."""
    from lare_rl.new_task.single_agent import draft

    if Path(named).exists():
        from lare_rl.logs.draft_from_log import draft_of_logs

        return draft_of_logs(named)
    try:
        return draft(named)
    except LareError:
        if find_spec("minari") is None:
            raise
        from lare_rl.logs.draft_from_log import draft_of_logs
        from lare_rl.logs.minari import is_local

        if not is_local(named):
            raise
        return draft_of_logs(named)


def verify(
    file: Annotated[Positional[Path], tyro.conf.arg(metavar="FILE")],
    task: Annotated[str, tyro.conf.arg(metavar="TASK")],
    kind: Kind = "factors",
    data: Data = None,
    fit: int = 0,
    policy: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None,
    judges: Judges | None = None,
) -> None:
    """Verify a function: it is read, never executed, and its factors must be finite. Prints the entries that each factor reads.

    With --fit, also print how much of the returns of some episodes its factors explain, and how much each factor contributes.

    Exit status 0: it passes. 1: it does not, and every reason is printed. 2: it could not be checked.

    Args:
        file: Python source, a function that `lare-rl design` saved, or a model's reply to the request of `lare-rl prompt` (.json).
        task: a shipped name (see `lare-rl tasks`), or the path of a task file.
        kind: what the function returns: several factors, or one reward.
        data: logged episodes; the function is checked on their steps instead of random steps of the environment. A directory, a
            Parquet file, or the id of a local Minari data set.
        fit: number of episodes, 20 or more, whose returns the factors are fitted to: the first of --data, or episodes that are
            played with random actions, the same in every call.
        policy: a run whose policy plays the episodes for --fit, instead of random actions.
        judges: which observation of a step the function judges, instead of the one that the task says.
    """
    from lare_rl.cli.design import policy_that_plays
    from lare_rl.credit.explanation_text import FEWEST
    from lare_rl.envs.load import load_task, read_task
    from lare_rl.latent.function import of_verdict
    from lare_rl.latent.saved import read_source
    from lare_rl.latent.verify import verify as verify_source
    from lare_rl.tasks.spec import the_role

    source, changed, written_for = read_source(file)
    if fit and fit < FEWEST:
        raise LareError(f"fit = {fit}: at least {FEWEST} episodes are needed")
    if policy is not None and (not fit or data is not None):
        raise LareError("--policy plays the episodes for --fit: give --fit a number of episodes, and no --data")
    spec = load_task(task) if data is None else read_task(task)
    spec = spec if judges is None else spec.model_copy(update={"judges": judges})
    plays = policy_that_plays(policy, spec)
    if changed:
        say("note    the source was changed after it was saved: its hash differs")
    role = the_role(spec)
    if written_for not in (None, role.name):
        say(f"note    it was written for the task {written_for!r}")
    verdict = verify_source(source, spec, kind, steps_of(data, spec))
    say(f"for {role.name}: observations of {role.observation_size} numbers, actions of {role.action_size}")
    for check in verdict.checks:
        say(f"{'passed' if check.passed else 'FAILED'}  {check.name}")
        for line in check.message.splitlines():
            say(f"        {line}")
    for line in verdict.advice:
        say(f"advice  {line}")
    if not verdict.passed:
        if file.suffix == ".json":
            say("Paste the lines after FAILED into the same chat, and ask for the whole reply again, corrected.")
        sys.exit(1)
    function = of_verdict(source, role, kind, verdict)
    for name, reads in zip(function.names, function.reads, strict=True):
        say(f"factor  {name} reads {reads}")
    if fit:
        say_what_returns_say(function, role, episodes_for(role, data, fit, plays))


def episodes_for(role: "TaskSpec", data: str | None, count: int, policy: "Policy | None") -> "Sequence[Episode]":
    """Episodes of a log, or of the environment."""
    if data is not None:
        from lare_rl.logs.steps import logged_episodes

        return logged_episodes(data, role, count)
    from lare_rl.envs.play import episodes_of

    progress(f"playing {count} episodes by {'random actions' if policy is None else 'the policy'}")
    return episodes_of(role, count, policy)


def say_what_returns_say(function: "LatentFunction", role: "TaskSpec", episodes: "Sequence[Episode]") -> None:
    """Print how well the factors explain the returns of some episodes."""
    from lare_rl.credit.explanation_text import error_shown, r2_shown
    from lare_rl.training.reflect import told_by_returns

    found = told_by_returns(function, role, episodes)
    if len({one.total for one in episodes}) == 1:
        say(f"All {len(episodes)} episodes have the same return, which says nothing about the factors.")
        if role.environment != "none":
            say(
                "Does the environment pay before its time limit (max_episode_steps)? If it does, let its score differ between bad "
                "episodes too: a grade that is 0 for all random actions teaches nothing."
            )
        return
    if math.isfinite(found.r2):
        say(
            f"Returns of episodes not seen yet, predicted by the factors: R² = {r2_shown(found.r2)} (1: exactly; 0: no better than "
            f"their mean), with a standard error of {error_shown(found.r2_error)}. LaRe predicted each return from the episodes "
            "before it. The first predictions had few such episodes: if the factors are right, R² usually rises with more. Rare "
            "events need many. If R² remains below about 0.8, phi lacks something that the score depends on, or a part of the "
            "score is noise or is decided by the initial state."
        )
        if found.r2_of_lengths is not None:
            say(
                f"Predicted by the lengths of these episodes alone, without a factor: R² = {r2_shown(found.r2_of_lengths)}."
            )
        say(
            f"Fitted to all {len(episodes)} episodes (such shares may be high where R² is low, because these returns were seen):"
        )
    for line in found.sentences:
        say(line)

"""Latent functions: the request, a task of one's own, verification."""

import sys
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from lare.cli.terminal import Kind, Task, say, write_new


def prompt(task: Task, kind: Kind = "factors") -> None:
    """Print the request that a language model gets for a task.

    Args:
        task: a shipped name (see `lare tasks`), or the path of a task file.
        kind: what is asked for: several factors, or one reward.
    """
    from lare.llm.prompts import candidate
    from lare.tasks.spec import load_task, the_role

    for message in candidate(the_role(load_task(task)), kind):
        say(f"--- {message['role']} ---\n{message['content']}\n")


def new_task(
    environment: Annotated[Positional[str], tyro.conf.arg(metavar="ENV_ID")],
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> None:
    """Write a first task file of an environment, from its spaces and its documentation.

    Whatever speaks of rewards is left out, and what could not be found is marked for you to fill in. Where the agents are
    of several kinds, a file for each kind is written beside it.

    Args:
        environment: a Gymnasium id, as Pendulum-v1; module:id imports the module that registers it first; or
            pettingzoo/MODULE:NAME, where NAME makes a PettingZoo ParallelEnv.
        out: the file to write, which must not exist; the task's name with .toml unless given.
    """
    from lare.tasks.new import draft

    drafted = draft(environment)
    path = out or Path(f"{drafted.name}.toml")
    write_new(path, drafted.toml, "--out")
    for name, text in drafted.teams.items():
        write_new(path.parent / name, text, "folder for --out")
    left_out = f"; {drafted.left_out} sentences or rows that spoke of rewards were left out" if drafted.left_out else ""
    say(f"wrote {', '.join(map(str, (path, *(path.parent / name for name in drafted.teams))))}{left_out}")
    for key in drafted.missing:
        say(f"  fill in: {key} (the environment does not document it)")
    say(f"read it, then: lare design {path} --model NAME --out phi.py")
    say(f"or, without a model: write phi.py by what lare prompt {path} says; --method rrdu needs none")


def verify(
    file: Annotated[Positional[Path], tyro.conf.arg(metavar="FILE")],
    task: Annotated[str, tyro.conf.arg(metavar="TASK")],
    kind: Kind = "factors",
) -> None:
    """Verify a function: what it may contain, and what it must do. It runs in a process without rights.

    Exit status 0: it passes. 1: it does not, and every reason is printed. 2: it could not be tried.

    Args:
        file: Python source, or a function that `lare design` saved.
        task: a shipped name (see `lare tasks`), or the path of a task file.
        kind: what it is to return: several factors, or one reward.
    """
    from lare.latent.function import read_source
    from lare.latent.verify import verify as verify_source
    from lare.tasks.spec import load_task

    source, changed = read_source(file)
    if changed:
        say("note    the source is not the one that was saved: its hash is another")
    verdict = verify_source(source, load_task(task), kind)
    for check in verdict.checks:
        say(f"{'passed' if check.passed else 'FAILED'}  {check.name}")
        for line in check.message.splitlines():
            say(f"        {line}")
    for line in verdict.advice:
        say(f"advice  {line}")
    if verdict.isolation:
        say(f"It ran in {verdict.isolation}.")
    if not verdict.passed:
        sys.exit(1)

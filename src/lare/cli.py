"""The command line. Each command is one function; its arguments are its options, and tyro writes the help.

What is slow to import is imported by the command that needs it.
"""

import sys
import traceback
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from lare.errors import LareError
from lare.training.settings import Settings

Task = Annotated[Positional[str], tyro.conf.arg(metavar="TASK")]
Kind = Literal["factors", "reward"]
DEFAULTS = Settings()


def tasks() -> None:
    """List the tasks that come with the package."""
    from rich.console import Console
    from rich.table import Table

    from lare.tasks.spec import read_task, shipped_tasks

    table = Table("task", "environment", "observation", "action", "judges", box=None, pad_edge=False)
    for name in shipped_tasks():
        spec = read_task(name)
        table.add_row(name, spec.environment, str(spec.observation_size), str(spec.action_size), spec.judges)
    Console().print(table)


def prompt(task: Task, kind: Kind = "factors") -> None:
    """Print the request that a language model gets for a task.

    Args:
        task: a shipped name (see `lare tasks`), or the path of a task file.
        kind: what is asked for: several factors, or one reward.
    """
    from lare.llm.prompts import candidate
    from lare.tasks.spec import load_task

    for message in candidate(load_task(task), kind):
        say(f"--- {message['role']} ---\n{message['content']}\n")


def design(task: Task, kind: Kind = "factors", draw: int = 0, candidates: int = 5, out: Path | None = None) -> None:
    """Design the latent function of a task: candidates, combine, verify, correct.

    Prints the function, or writes it to a file that `lare train --function` takes.

    Args:
        task: a shipped name (see `lare tasks`), or the path of a task file.
        kind: what is asked for: several factors, or one reward.
        draw: which of the shipped recordings answers (0 to 4).
        candidates: first attempts that are combined; with 1, the attempt itself is the function.
        out: a .py file to write, with the replies and checks in a .json beside it; it must not exist.
    """
    from lare.latent.design import design as design_function
    from lare.tasks.spec import load_task

    for path in (out.with_suffix(".py"), out.with_suffix(".json")) if out is not None and out.name else ():
        if path.exists():
            raise LareError(f"{path} exists, and is not overwritten; choose another --out")
    function = design_function(load_task(task), kind, draw=draw, candidates=candidates)
    if out is None:
        say(function.source)
    else:
        function.save(out)
        say(f"wrote {out.with_suffix('.py')}: {function.size} factors ({', '.join(function.names)})")


def evaluate(
    run: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN")], episodes: int = 10, video: Path | None = None
) -> None:
    """Evaluate the policy of a run by its true return.

    Args:
        run: a run directory.
        episodes: episodes of the deterministic policy, for each seed.
        video: a .gif to write of one episode of the first seed (.mp4 with the extra lare-rl[video]).
    """
    from lare.experiments.evaluation import evaluate_run, record_video

    returns = evaluate_run(run, episodes)
    for seed, of_seed in returns.items():
        say(f"seed {seed}: return {of_seed.mean():.1f} ± {of_seed.std():.1f} over {episodes} episodes")
    if video is not None:
        record_video(run, video)
        say(f"wrote {video}")


def report(
    runs: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN")], out: Path | None = None
) -> None:
    """Draw a report of one or more runs: one HTML file that needs nothing else.

    Args:
        runs: run directories; their learning curves are laid over each other, named by method.
        out: the file to write; report.html in the (first) run's directory unless given.
    """
    from lare.experiments.report import write_report

    say(f"wrote {write_report(list(runs), out)}")


def train(
    task: Annotated[Positional[str | None], tyro.conf.arg(metavar="[TASK]")] = None,
    settings: Annotated[Settings, tyro.conf.arg(name="")] = DEFAULTS,
    function: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    resume: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    tensorboard: bool = False,
) -> None:
    """Train on a task's episodic rewards. Ctrl-C saves and leaves; --resume goes on.

    Args:
        task: a shipped name (see `lare tasks`), or the path of a task file. Not given with --resume.
        function: a latent function (.py) to use instead of a recorded one. It is verified before it is run.
        out: the run directory, which must not exist; runs/TASK-METHOD-ALGORITHM-sSEED unless given.
        resume: a run directory to go on with, from its last checkpoint and with its own settings.
        tensorboard: write TensorBoard events into the run directory too (needs the extra lare-rl[tensorboard]).
    """
    import lare

    if resume is not None:
        if (task, function, out, settings) != (None, None, None, DEFAULTS):
            raise LareError("--resume goes on with the run's own settings: give it no task and no other settings")
        run = lare.resume(resume, tensorboard=tensorboard)
    elif task is None:
        raise LareError("say what to train on: lare train TASK (lare tasks lists them), or lare train --resume DIR")
    else:
        spec = lare.load_task(task)
        phi = lare.load_function(function, spec) if function else None
        run = lare.train(spec, settings, function=phi, out=out, tensorboard=tensorboard)
    say(f"finished {run.directory}; to see it: lare report {run.directory}")


def say(text: str) -> None:
    print(text)  # noqa: T201 - the one place that writes to standard output


DESCRIPTION = "Train reinforcement learning on episodic rewards, through latent rewards that a language model wrote."
COMMANDS = {"tasks": tasks, "prompt": prompt, "design": design, "train": train, "evaluate": evaluate, "report": report}


def main() -> None:
    """`lare`: a mistake of the user's is one line on stderr and exit status 2 (--debug shows where it came from)."""
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    debug = len(arguments) < len(sys.argv) - 1
    try:
        tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="lare", description=DESCRIPTION, args=arguments)
    except LareError as error:
        if debug:
            traceback.print_exc()
        sys.stderr.write(f"lare: {' '.join(str(error).split())}\n")
        sys.exit(130 if type(error).__name__ == "Interrupted" else 2)
    except KeyboardInterrupt:
        sys.exit(130)

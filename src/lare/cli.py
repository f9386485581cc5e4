"""The command line. Each command is one function; its arguments are its options, and tyro writes the help.

What is slow to import is imported by the command that needs it.
"""

import os
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

    table = Table("task", "observation", "action", "judges", "agents", box=None, pad_edge=False)
    table.columns[0].no_wrap = True
    for name in shipped_tasks():
        spec = read_task(name)
        agents = "many" if spec.particles else "of one team" if spec.whole else "one"
        table.add_row(name, str(spec.observation_size), str(spec.action_size), spec.judges, agents)
    Console().print(table)


def methods() -> None:
    """List the ways to assign credit, and where each comes from."""
    from rich.console import Console
    from rich.table import Table

    from lare.credit.methods import TABLE

    table = Table("method", "what the algorithm is trained on", "source", box=None, pad_edge=False)
    for method in TABLE:
        agents = " (many agents)" if method.for_many_only else ""
        table.add_row(method.name, method.summary + agents, method.source)
    Console().print(table)


def algorithms() -> None:
    """List the reinforcement learning algorithms, and where each comes from."""
    from rich.console import Console
    from rich.table import Table

    from lare.algorithms.table import TABLE

    table = Table("algorithm", "learns", "what it is", "source", box=None, pad_edge=False)
    for algorithm in TABLE:
        table.add_row(algorithm.name, algorithm.kind, algorithm.summary, algorithm.source)
    Console().print(table)


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
    """Write a first task file of a Gymnasium environment, from its spaces and its documentation.

    Whatever speaks of rewards is left out, and what could not be found is marked for you to fill in.

    Args:
        environment: a Gymnasium id, as Pendulum-v1; module:id imports the module that registers it first.
        out: the file to write, which must not exist; ENV_ID.toml unless given.
    """
    from lare.tasks.new import draft

    drafted = draft(environment)
    path = out or Path(f"{environment.rpartition(':')[2].replace('/', '-')}.toml")
    write_new(path, drafted.toml, "--out")
    say(f"wrote {path}; {drafted.left_out} sentences or rows that spoke of rewards were left out")
    for key in drafted.missing:
        say(f"  fill in: {key} (the environment does not document it)")
    say(f"read it, then: lare prompt {path}; lare design {path} --model NAME --out phi.py")


def design(
    task: Task,
    kind: Kind = "factors",
    model: str | None = None,
    base_url: str | None = None,
    draw: int = 0,
    candidates: int = 5,
    reflect: int = 0,
    pre_verification: bool = True,
    budget: int = 400_000,
    requests: int = 60,
    price: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="IN OUT")] = None,
    temperature: float | None = None,
    record: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> None:
    """Design the latent function of a task: candidates, combine, verify, correct.

    Prints the function, or writes it to a file that `lare train --function` takes. A live model needs the extra
    lare-rl[llm]; its key comes from the environment variable OPENAI_API_KEY, and is never written down.

    Args:
        task: a shipped name (see `lare tasks`), or the path of a task file.
        kind: what is asked for: several factors, or one reward.
        model: whom to ask: "recorded" (the shipped recordings, and the default), the path of a recording (.json), or
            the name of a model behind an OpenAI-compatible endpoint.
        base_url: the endpoint (OpenAI's, or that of OPENAI_BASE_URL, unless given); http://localhost:11434/v1 is Ollama's.
        draw: which of the shipped recordings answers (0 to 4).
        candidates: first attempts that are combined; with 1, the attempt itself is the function (the paper's ablation
            without self-prompting).
        reflect: further rounds, in which the model sees how its factors go with the return, and may improve them.
        pre_verification: without it (the paper's ablation), the first reply is tried once, in its jail, and kept as it is.
        budget: tokens, in and out together, that are never passed.
        requests: requests that are never passed.
        price: of a million tokens in and out, to have the cost reckoned.
        temperature: of the model; the server's own unless given.
        record: a file that takes every exchange, for --model FILE; it must not exist.
        out: a .py file to write, with the replies and checks in a .json beside it; it must not exist.
    """
    from lare.latent.design import DesignFailed
    from lare.latent.design import design as design_function
    from lare.llm.live import Budget, LiveModel
    from lare.llm.model import RECORDED, recorded_model
    from lare.tasks.spec import load_task

    for path in (out.with_suffix(".py"), out.with_suffix(".json")) if out is not None and out.name else ():
        if path.exists():
            raise LareError(f"{path} exists, and is not overwritten; choose another --out")
    spec, cost = load_task(task), Budget(requests, budget)
    if model is None or model == RECORDED:
        asked = recorded_model(spec.name, kind, draw)
    elif model.endswith(".json"):
        asked = recorded_model(spec.name, kind, path=Path(model))
    else:
        asked = LiveModel(model, base_url, temperature, cost, said=progress)
    try:
        function = design_function(
            spec,
            kind,
            asked,
            candidates=candidates,
            reflect=reflect,
            pre_verification=pre_verification,
            record=record,
            said=progress,
        )
    except DesignFailed as error:
        path = record or free_name(Path(f"{spec.name}.attempts.json"))
        if record is None:
            error.recorder.write(path, error.model)
        progress(f"lare: {error}\nevery attempt is kept in {path}")
        sys.exit(1)
    finally:
        if cost.requests_made:
            progress(f"{asked.name}: {cost.summary(price)}")
    if out is None:
        say(function.source)
    else:
        function.save(out)
        say(f"wrote {out.with_suffix('.py')}: {function.size} factors ({', '.join(function.names)})")


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

    verdict = verify_source(read_source(file), load_task(task), kind)
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


def evaluate(
    run: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN")], episodes: int = 10, video: Path | None = None
) -> None:
    """Evaluate the policy of a run by its true return.

    Args:
        run: a run directory.
        episodes: episodes for each seed. A single agent acts without noise, agents of particle tasks as in training.
        video: a .gif to write of one episode of the first seed (.mp4 with the extra lare-rl[video]).
    """
    from lare.experiments.evaluation import evaluate_run, record_video
    from lare.training.run import open_run

    returns = evaluate_run(run, episodes)
    for team, of_team in returns.items():
        for seed, of_seed in zip(open_run(run).seeds, of_team, strict=True):
            named = f"{team}, " if len(returns) > 1 else ""
            say(f"{named}seed {seed}: return {of_seed.mean():.1f} ± {of_seed.std():.1f} over {episodes} episodes")
    if video is not None:
        record_video(run, video)
        say(f"wrote {video}")


def cross_play(
    first: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN")],
    second: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN")],
    episodes: int = 200,
) -> None:
    """Let the first team of each of two runs meet the other team of each, every seed against every seed.

    Prints the first team's return, mean and standard deviation over the pairs of seeds.

    Args:
        first: a run of a task in which two teams learn, as CompetitivePP-6.
        second: another run of the same task.
        episodes: episodes of each pair.
    """
    from rich.console import Console
    from rich.table import Table

    from lare.experiments.agents import cross_play as play
    from lare.training.run import open_run

    runs = open_run(first), open_run(second)
    matches = play(runs, episodes)
    task = runs[0].config.task
    ours, theirs = (task.team(role) for role in task.teams)
    table = Table(f"{ours} of, against {theirs} of", str(first), str(second), box=None, pad_edge=False)
    for name, row in zip((first, second), (matches[:2], matches[2:]), strict=True):
        shown = (f"{match.returns.mean():.1f} ± {match.returns.std(ddof=match.returns.size > 1):.1f}" for match in row)
        table.add_row(str(name), *shown)
    Console().print(table)
    say(
        f"Returns of the {ours} team: mean ± standard deviation over all pairs of a seed of one run and a seed of the other, "
        f"{episodes} episodes each."
    )


def sweep(
    file: Annotated[Positional[Path], tyro.conf.arg(metavar="FILE")],
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None,
) -> None:
    """Train many runs: what a TOML file asks for and is not done yet. All metrics go to results.csv and .parquet.

    Args:
        file: tasks, methods, algorithms, draws, settings; processes at a time, and cores of each (docs/sweeps.md).
        ray: a Ray cluster to train on instead of this machine, or local (needs the extra lare-rl[ray]).
    """
    from lare.experiments.sweep import read_sweep, run_sweep
    from lare.experiments.tables import rows_of, write_table

    wanted, jobs = read_sweep(file)
    root = jobs[0].directory.parent.parent
    try:
        failed = run_sweep(wanted, jobs, progress, ray)
    finally:
        rows = rows_of(job.directory for job in jobs)
        if rows:
            for path in write_table(rows, root / "results"):
                say(f"wrote {path}")
    if failed:
        sys.exit(1)


def compare(
    runs: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN")], out: Path = Path("compare.html")
) -> None:
    """Compare methods by their runs: interquartile means with bootstrap intervals, profiles, probability of improvement.

    Args:
        runs: run directories, or directories that hold some, as that of a sweep; the first run's method is what the others are
            compared with.
        out: the page to write.
    """
    from rich.console import Console
    from rich.table import Table

    from lare.experiments.compare import HEAD, cells, find_runs, what_scores_are, write_comparison

    comparison = write_comparison(find_runs(runs), out)
    table = Table(*HEAD, box=None, pad_edge=False)
    for row in cells(comparison):
        table.add_row(*row)
    Console().print(table)
    say(what_scores_are(comparison))
    say(f"wrote {out}")


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
    function: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="FILE")] = (),
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    resume: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    tensorboard: bool = False,
) -> None:
    """Train on a task's episodic rewards. Ctrl-C saves and leaves; --resume goes on.

    Args:
        task: a shipped name (see `lare tasks`), or the path of a task file. Not given with --resume.
        function: a latent function (.py) to use instead of a recorded one, verified before it is run. Where several teams learn,
            one --function for each, in the order of the task.
        out: the run directory, which must not exist; runs/TASK-METHOD-ALGORITHM-sSEED unless given.
        resume: a run directory to go on with, from its last checkpoint and with its own settings.
        tensorboard: write TensorBoard events into the run directory too (needs the extra lare-rl[tensorboard]).
    """
    import lare
    from lare.latent.function import load, per_role

    if resume is not None:
        if (task, function, out, settings) != (None, (), None, DEFAULTS):
            raise LareError("--resume goes on with the run's own settings: give it no task and no other settings")
        run = lare.resume(resume, tensorboard=tensorboard)
    elif task is None:
        raise LareError("say what to train on: lare train TASK (lare tasks lists them), or lare train --resume DIR")
    else:
        spec = lare.load_task(task)
        functions = [load(file, role) for file, role in per_role(function, spec)] if function else None
        run = lare.train(spec, settings, function=functions, out=out, tensorboard=tensorboard)
    say(f"finished {run.directory}; to see it: lare report {run.directory}")


def say(text: str) -> None:
    print(text)  # noqa: T201 - the one place that writes to standard output


def progress(text: str) -> None:
    """What is worth knowing on the way, apart from the result."""
    sys.stderr.write(text + "\n")


def free_name(path: Path) -> Path:
    """The path itself, or one with a number behind it as long as that is taken."""
    number = 1
    while path.exists():
        number += 1
        path = path.with_name(f"{path.name.split('.attempts')[0]}.attempts-{number}.json")
    return path


def write_new(path: Path, text: str, option: str) -> None:
    """Write a file that must not be there."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise LareError(f"{path} exists, and is not overwritten; choose another {option}") from None
    except OSError as error:
        raise LareError(f"{path} cannot be written: {error.strerror}") from error


DESCRIPTION = "Train reinforcement learning on episodic rewards, through latent rewards that a language model wrote."
COMMANDS = {
    "tasks": tasks,
    "methods": methods,
    "algorithms": algorithms,
    "new-task": new_task,
    "prompt": prompt,
    "design": design,
    "verify": verify,
    "train": train,
    "evaluate": evaluate,
    "sweep": sweep,
    "report": report,
    "compare": compare,
    "cross-play": cross_play,
}


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
    except BrokenPipeError:
        # Whoever read the output has read enough. Python would complain again when it flushes at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)

"""The commands that list tasks, methods and algorithms."""

from typing import TYPE_CHECKING

from lare_rl.cli.terminal import show

if TYPE_CHECKING:
    from lare_rl.algorithms.table import Algorithm
    from lare_rl.credit.methods import Method


def tasks() -> None:
    """List the tasks that come with the package. `lare-rl prompt TASK` describes one of them."""
    from lare_rl.envs.families import FAMILIES
    from lare_rl.envs.load import read_task, shipped_tasks

    specs = [read_task(name) for name in shipped_tasks()]
    show(
        ("task", "observation", "action", "judges", "agents"),
        (
            (
                spec.name,
                str(spec.observation_size),
                str(spec.action_size),
                spec.judges,
                "of one team" if spec.team else "many" if spec.family in FAMILIES else "one",
            )
            for spec in specs
        ),
    )


def methods() -> None:
    """List the ways to assign credit, and where each comes from."""
    from lare_rl.credit.methods import TABLE

    show(
        ("method", "what the algorithm is trained on", "source"),
        ((row.name, row.summary + for_whom(row), row.source) for row in TABLE),
    )


def for_whom(method: "Method") -> str:
    """A note on methods that are only for one agent or only for many."""
    return " (many agents)" if method.for_many_only else " (one agent)" if method.for_one_only else ""


def algorithms() -> None:
    """List the reinforcement learning algorithms, and where each comes from."""
    from lare_rl.algorithms.table import TABLE

    show(
        ("algorithm", "consumes", "agents", "actions", "what it is", "source"),
        ((row.name, row.consumes, for_agents(row), for_actions(row), row.summary, row.source) for row in TABLE),
    )


def for_agents(row: "Algorithm") -> str:
    """How many agents an algorithm trains."""
    return "any" if row.one_agent and row.many_agents else "many" if row.many_agents else "one"


def for_actions(row: "Algorithm") -> str:
    """Which actions an algorithm takes."""
    return "any" if row.continuous and row.discrete else "continuous" if row.continuous else "discrete"

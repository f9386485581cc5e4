"""The commands that list tasks, methods and algorithms."""

from typing import TYPE_CHECKING

from lare_rl.cli.terminal import print_table

if TYPE_CHECKING:
    from lare_rl.algorithms.registry import Algorithm
    from lare_rl.credit.methods import Method


def tasks() -> None:
    """List the tasks that come with the package. `lare-rl prompt TASK` describes one of them."""
    from lare_rl.envs.families import find_family
    from lare_rl.envs.load import read_task, shipped_tasks

    specs = [read_task(name) for name in shipped_tasks()]
    print_table(
        ("task", "observation", "action", "scored_observation", "agents"),
        (
            (
                spec.name,
                str(spec.observation_size),
                str(spec.action_size),
                spec.scored_observation,
                "of one team" if spec.team else "one" if find_family(spec).single_agent else "many",
            )
            for spec in specs
        ),
    )


def methods() -> None:
    """List the ways to assign credit, and where each comes from."""
    from lare_rl.credit.methods import METHODS

    print_table(
        ("method", "what the algorithm is trained on", "source"),
        ((method.name, method.summary + _agents_note(method), method.source) for method in METHODS.values()),
    )


def _agents_note(method: "Method") -> str:
    return " (many agents)" if method.multi_agent_only else " (one agent)" if method.single_agent_only else ""


def algorithms() -> None:
    """List the reinforcement learning algorithms, and where each comes from."""
    from lare_rl.algorithms.registry import ALGORITHMS

    print_table(
        ("algorithm", "consumes", "agents", "actions", "what it is", "source"),
        (_algorithm_row(algorithm) for algorithm in ALGORITHMS.values()),
    )


def _algorithm_row(algorithm: "Algorithm") -> tuple[str, ...]:
    agents = "one" if not algorithm.multi_agent else "any" if algorithm.single_agent else "many"
    actions = "discrete" if not algorithm.continuous else "any" if algorithm.discrete else "continuous"
    return algorithm.name, algorithm.consumes, agents, actions, algorithm.summary, algorithm.source

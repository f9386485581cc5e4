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

    head = ("task", "observation", "action", "scored_observation", "agents")
    rows = []
    for task in map(read_task, shipped_tasks()):
        agents = "of one team" if task.team else "one" if find_family(task).single_agent else "many"
        rows.append((task.name, str(task.observation_size), str(task.action_size), task.scored_observation, agents))
    print_table(head, rows)


def methods() -> None:
    """List the ways to assign credit, and where each comes from."""
    from lare_rl.credit.methods import METHODS

    rows = []
    for method in METHODS.values():
        agents = agents_of_method(method)
        rows.append((method.name, method.summary + (f" ({agents})" if agents else ""), method.source))
    print_table(("method", "what the algorithm is trained on", "source"), rows)


def agents_of_method(method: "Method") -> str:
    """Return the number of agents that a method is limited to, or an empty text."""
    return "many agents" if method.multi_agent_only else "one agent" if method.single_agent_only else ""


def algorithms() -> None:
    """List the reinforcement learning algorithms, and where each comes from."""
    from lare_rl.algorithms.registry import ALGORITHMS

    rows = ((row.name, row.consumes, *abilities(row), row.summary, row.source) for row in ALGORITHMS.values())
    print_table(("algorithm", "consumes", "agents", "actions", "what it is", "source"), rows)


def abilities(algorithm: "Algorithm") -> tuple[str, str]:
    """Return how many agents an algorithm trains, and which actions they may have."""
    agents = "one" if not algorithm.multi_agent else "any" if algorithm.single_agent else "many"
    return agents, "discrete" if not algorithm.continuous else "any" if algorithm.discrete else "continuous"

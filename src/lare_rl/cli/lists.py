"""The commands that list tasks, methods and algorithms."""

from typing import TYPE_CHECKING

from lare_rl.cli.terminal import print_table

if TYPE_CHECKING:
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

    def note(method: "Method") -> str:
        return " (many agents)" if method.multi_agent_only else " (one agent)" if method.single_agent_only else ""

    print_table(
        ("method", "what the algorithm is trained on", "source"),
        ((method.name, method.summary + note(method), method.source) for method in METHODS.values()),
    )


def algorithms() -> None:
    """List the reinforcement learning algorithms, and where each comes from."""
    from lare_rl.algorithms.registry import ALGORITHMS

    rows = []
    for row in ALGORITHMS.values():
        agents = "one" if not row.multi_agent else "any" if row.single_agent else "many"
        actions = "discrete" if not row.continuous else "any" if row.discrete else "continuous"
        rows.append((row.name, row.consumes, agents, actions, row.summary, row.source))
    print_table(("algorithm", "consumes", "agents", "actions", "what it is", "source"), rows)

"""How much is spent on an exhibit."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from lare.algorithms.ppo import PPOSettings
from lare.algorithms.table import ALGORITHMS, Kind
from lare.credit.decomposition import CreditSettings
from lare.training.settings import AgentSettings, RolloutSettings

Name = Literal["smoke", "laptop", "paper"]


@dataclass(frozen=True)
class Budget:
    """What all runs of an exhibit have in common."""

    name: Name
    seeds: int
    draws: int
    """Of the language model, at most."""
    functions: int
    """The same where nothing is trained."""
    episodes: int
    """That correlations are taken over."""
    tabular: tuple[int, int]
    """Episodes, and runs, of the tabular problems."""
    steps: int | None = None
    """Environment steps of single agents; their default, unless given."""
    steps_of_many: int | None = None
    """The same for tasks of many."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Whatever else differs from what is usual."""


SMALL = CreditSettings(hidden=(8,), drawn_steps=4, steps=16)
MINIATURE = {
    "evaluate_every": 600,
    "evaluation_episodes": 2,
    **{
        row.name: row.settings.model_copy(update={"hidden": (8,), "batch_size": 8, "warmup": 100})
        for row in ALGORITHMS.values()
        if row.kind is Kind.OFF_POLICY
    },
    "ppo": PPOSettings(hidden=(8,), minibatch_size=16, epochs=2),
    "rollout": RolloutSettings(steps=200, fit_updates=2),
    "credit": SMALL,
    "ippo": PPOSettings(hidden=(8,), minibatch_size=100, epochs=1),
    "agents": AgentSettings(episodes=4, fit_every=1, fit_updates=2, capacity=16, credit=SMALL),
}
"""Networks of a few units: it runs, and learns nothing."""

BUDGETS: Mapping[str, Budget] = {
    budget.name: budget
    for budget in (
        Budget(
            "smoke",
            seeds=1,
            draws=1,
            functions=1,
            episodes=2,
            tabular=(50, 3),
            steps=1200,
            steps_of_many=600,
            settings=MINIATURE,
        ),
        Budget("laptop", seeds=3, draws=3, functions=5, episodes=40, tabular=(2000, 20), steps=50_000),
        Budget("paper", seeds=5, draws=5, functions=5, episodes=400, tabular=(20_000, 100)),
    )
}

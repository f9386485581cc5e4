"""How much is spent on an exhibit."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from lare.algorithms.settings import PPOSettings, QMIXSettings
from lare.algorithms.table import ALGORITHMS, Consumes
from lare.credit.settings import CreditSettings

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
    by_algorithm: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """The same for some of the algorithms."""


SMALL = CreditSettings(hidden=(8,), drawn_steps=4, steps=16)
MINIATURE = {
    "evaluate_every": 600,
    "evaluation_episodes": 2,
    **{
        row.name: row.settings.model_copy(update={"hidden": (8,), "batch_size": 8, "warmup": 100})
        for row in ALGORITHMS.values()
        if row.consumes is Consumes.TRANSITIONS
    },
    "ppo": PPOSettings(hidden=(8,), minibatch_size=16, epochs=2, normalise_observations=True),
    "ippo": PPOSettings(hidden=(8,), minibatch_size=100, epochs=1),
    "credit": SMALL,
}
"""Networks of a few units: it runs, and learns nothing."""
FEW = QMIXSettings(hidden=8, embed=4, hypernet=8, batch_size=4, update_every=4)
SHORT: Mapping[str, Mapping[str, Any]] = {
    "ppo": {"fit_updates": 2, "rollout_steps": 200},
    "ippo": {"fit_updates": 2, "fit_every": 1, "environments": 4},
    "qmix": {"environments": 2, "steps": 1200, "qmix": FEW},
}
LAPTOP: Mapping[str, Mapping[str, Any]] = {
    "ippo": {"first_fit": "published"},
    "qmix": {
        "steps": 200_000,
        "evaluate_every": 20_000,
        "qmix": QMIXSettings(batch_size=32, update_every=4, epsilon_steps=50_000),
    },
}
"""Twice as many updates as PyMARL2 makes, each on a quarter of the episodes: within 200,000 steps updates are what is scarce."""
PAPER: Mapping[str, Mapping[str, Any]] = {"ippo": {"first_fit": "published"}, "qmix": {"steps": 10_050_000}}

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
            by_algorithm=SHORT,
        ),
        Budget(
            "laptop",
            seeds=3,
            draws=3,
            functions=5,
            episodes=40,
            tabular=(2000, 20),
            steps=50_000,
            by_algorithm=LAPTOP,
        ),
        Budget("paper", seeds=5, draws=5, functions=5, episodes=400, tabular=(20_000, 100), by_algorithm=PAPER),
    )
}

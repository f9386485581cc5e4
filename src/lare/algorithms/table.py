"""The table of algorithms: who learns from the rewards that a method gives.

A row is a name with hyperparameters of its own. Two that differ in these alone share their equations: `ddpg` is `td3.py` with one
critic, no noise on the target action and no delay; `ippo` is `ppo.py` with all agents as one.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from lare.algorithms.ppo import PPOSettings
from lare.algorithms.sac import SACSettings
from lare.algorithms.td3 import TD3Settings

AlgorithmSettings = TD3Settings | SACSettings | PPOSettings


class Kind(StrEnum):
    """What an algorithm learns from, and for whom."""

    OFF_POLICY = "off-policy"
    """From a replay of all that was met."""
    ON_POLICY = "on-policy"
    """From what the newest policy met."""
    MANY_AGENTS = "many agents"
    """From what the newest policy of all agents met."""


@dataclass(frozen=True)
class Algorithm:
    """One row: a published name."""

    name: str
    kind: Kind
    settings: AlgorithmSettings
    """The published hyperparameters."""
    summary: str
    source: str


DDPG = TD3Settings(critics=1, policy_noise=0.0, policy_delay=1)
PPO = PPOSettings(hidden=(256, 256), entropy_coef=0.01, anneal=True)
IPPO = PPOSettings(
    learning_rate=1e-4, gamma=1.0, minibatch_size=128, clip=0.5, entropy_coef=0.01, max_grad_norm=10.0, anneal=True
)

TABLE = (
    Algorithm(
        "td3",
        Kind.OFF_POLICY,
        TD3Settings(),
        "two critics against overestimation, a delayed deterministic policy",
        "Fujimoto et al., ICML 2018",
    ),
    Algorithm(
        "ddpg",
        Kind.OFF_POLICY,
        DDPG,
        "one critic and a deterministic policy",
        "Lillicrap et al., ICLR 2016",
    ),
    Algorithm(
        "sac",
        Kind.OFF_POLICY,
        SACSettings(),
        "maximum entropy, with a learned temperature",
        "Haarnoja et al., 2018 (arXiv 1812.05905)",
    ),
    Algorithm(
        "ppo",
        Kind.ON_POLICY,
        PPO,
        "clipped policy steps on the newest rollout",
        "Schulman et al., 2017; a Gaussian takes the place of LaRe's Beta policy",
    ),
    Algorithm(
        "ippo",
        Kind.MANY_AGENTS,
        IPPO,
        "ppo for every agent, with one actor and one critic for all",
        "de Witt et al., 2020; hyperparameters of LaRe",
    ),
)

ALGORITHMS = {algorithm.name: algorithm for algorithm in TABLE}

Name = Literal["td3", "ddpg", "sac", "ppo", "ippo"]
"""The names of the table, for types and for the command line."""

"""The table of the reinforcement learning algorithms.

A row is a name with its own hyperparameters. Rows that differ only in these share their equations: `ddpg` is `td3.py` with one
critic, no noise on the target action and no delay; `ippo` is `ppo.py` for all agents at once.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from lare_rl.algorithms.settings import PPOSettings, QMIXSettings, SACSettings, TD3Settings

AlgorithmSettings = TD3Settings | SACSettings | PPOSettings | QMIXSettings


class Consumes(StrEnum):
    """What an update of an algorithm reads."""

    TRANSITIONS = "transitions"
    """Single steps from a replay of past steps."""
    ROLLOUTS = "rollouts"
    """The newest steps, taken by the newest policy."""
    SEQUENCES = "sequences"
    """Whole episodes from a replay."""


class Noise(StrEnum):
    """The exploration noise: independent random numbers, one for each entry of an action."""

    NORMAL = "normal"
    GUMBEL = "gumbel"
    """The choice with the largest logit plus noise is a sample from the softmax."""
    UNIFORM = "uniform"
    """With one more number for each agent, which decides whether it explores."""


@dataclass(frozen=True)
class Algorithm:
    """One row: a published name, what it consumes and what it can do."""

    name: str
    consumes: Consumes
    settings: AlgorithmSettings
    """The published hyperparameters."""
    summary: str
    source: str
    continuous: bool = True
    """Whether it supports continuous actions."""
    discrete: bool = True
    """Whether it supports discrete actions."""
    one_agent: bool = True
    """Whether it trains a single agent."""
    many_agents: bool = False
    """Whether it trains many agents."""
    many_teams: bool = False
    """Whether it trains several teams, each on its own rewards."""

    def noise(self, discrete: bool) -> Noise:
        """The kind of exploration noise for continuous or discrete actions."""
        if self.consumes is Consumes.SEQUENCES:
            return Noise.UNIFORM
        return Noise.GUMBEL if discrete else Noise.NORMAL

    def greedy(self, discrete: bool) -> bool:
        """Whether a policy acts without noise outside training.

        A policy over choices is trained as a distribution. Its most likely choice alone, always the same until the policy is
        nearly deterministic, can earn far less than the distribution does.
        """
        return self.consumes is not Consumes.ROLLOUTS or not (discrete or self.many_agents)


DDPG = TD3Settings(critics=1, policy_noise=0.0, policy_delay=1)
PPO = PPOSettings(hidden=(256, 256), entropy_coef=0.01, anneal=True, normalise_observations=True)
VDN = QMIXSettings(monotonic=False)
IPPO = PPOSettings(
    learning_rate=1e-4, gamma=1.0, minibatch_size=128, clip=0.5, entropy_coef=0.01, max_grad_norm=10.0, anneal=True
)
TABLE = (
    Algorithm(
        "td3",
        Consumes.TRANSITIONS,
        TD3Settings(),
        "two critics against overestimation, a delayed deterministic policy",
        "Fujimoto et al., ICML 2018",
        discrete=False,
    ),
    Algorithm(
        "ddpg",
        Consumes.TRANSITIONS,
        DDPG,
        "one critic and a deterministic policy",
        "Lillicrap et al., ICLR 2016",
        discrete=False,
    ),
    Algorithm(
        "sac",
        Consumes.TRANSITIONS,
        SACSettings(),
        "maximum entropy, with a learned temperature",
        "Haarnoja et al., 2018 (arXiv 1812.05905)",
        discrete=False,
    ),
    Algorithm(
        "ppo",
        Consumes.ROLLOUTS,
        PPO,
        "clipped policy steps on the newest rollout; observations are normalised",
        "Schulman et al., 2017; a Gaussian takes the place of LaRe's Beta policy",
    ),
    Algorithm(
        "ippo",
        Consumes.ROLLOUTS,
        IPPO,
        "ppo for every agent, with one actor and one critic for all",
        "de Witt et al., 2020; hyperparameters of LaRe",
        one_agent=False,
        many_agents=True,
        many_teams=True,
    ),
    Algorithm(
        "qmix",
        Consumes.SEQUENCES,
        QMIXSettings(),
        "a team's value as a monotonic mixture of its agents' values, each with a memory of its episode",
        "Rashid et al., ICML 2018; hyperparameters of PyMARL2 (Hu et al., 2021)",
        continuous=False,
        many_agents=True,
    ),
    Algorithm(
        "vdn",
        Consumes.SEQUENCES,
        VDN,
        "as qmix, with the sum of the agents' values",
        "Sunehag et al., AAMAS 2018; hyperparameters of PyMARL2",
        continuous=False,
        many_agents=True,
    ),
)

ALGORITHMS = {algorithm.name: algorithm for algorithm in TABLE}

Name = Literal["td3", "ddpg", "sac", "ppo", "ippo", "qmix", "vdn"]
"""The names of the table, for types and for the command line."""

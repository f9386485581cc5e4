"""What the compiled functions of a single agent's run hold fixed. (For many agents: `teams.py`.)"""

from dataclasses import dataclass

from lare.algorithms import ppo
from lare.algorithms.table import AlgorithmSettings
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import Encoder, Method


@dataclass(frozen=True)
class Recipe:
    """What is to be trained and how."""

    method: Method
    algorithm: AlgorithmSettings
    credit: CreditSettings
    scale_rewards: bool
    """Divide the rewards that the algorithm sees by the running root mean square of R/T."""
    observation_size: int
    action_size: int
    discrete: bool
    """Whether the actions are a choice: a row with a single 1."""
    factors: int
    longest_episode: int
    capacity: int
    steps: int
    """Of the whole run."""
    turn: int
    """Environment steps between two calls of `improve`."""
    fit_updates: int
    """ppo: updates of the decoder before each of the policy. An off-policy algorithm makes one with each of its own."""

    @property
    def warmup(self) -> int:
        """Environment steps with random actions before the first update."""
        return 0 if isinstance(self.algorithm, ppo.PPOSettings) else self.algorithm.warmup

    @property
    def features(self) -> int:
        """Size of what the decoder sees."""
        match self.method.encoder:
            case Encoder.LATENT:
                return self.factors
            case Encoder.TAKEN:
                return self.observation_size + self.action_size
            case _:
                return 2 * self.observation_size + self.action_size

"""The static configuration of a run's compiled functions."""

from dataclasses import dataclass

import jax
import numpy as np

from lare_rl.algorithms.table import Algorithm, AlgorithmSettings, Consumes, Noise
from lare_rl.credit.basis import Basis
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decomposition import SUM, forms_of
from lare_rl.credit.methods import Decoder, Encoder, Method
from lare_rl.envs.interface import EnvSpec
from lare_rl.tasks.spec import JudgedFrom, Judges, judged_states


@dataclass(frozen=True)
class TrainConfig:
    """What is trained, and how."""

    env: EnvSpec
    judged_from: JudgedFrom
    judges: Judges
    method: Method
    algorithm: Algorithm
    hyperparameters: AlgorithmSettings
    credit: CreditSettings
    scale_rewards: bool
    """Divide the rewards that the algorithm sees by the running root mean square of R/T."""
    factors: tuple[int, ...]
    """The number of factors of each team's latent function; empty for a method that needs none."""
    environments: int
    """The number of environments that each seed collects from."""
    rollout_steps: int
    """Steps of each environment in an iteration."""
    capacity: int
    """Rows of the replay, of each environment."""
    steps: int
    """Environment steps of the whole run."""
    fit_updates: int
    """Updates of the decoder in an iteration that fits it. Unused if the decoder is updated with every update of the algorithm."""
    deterministic: bool = False
    """Whether a policy acts without noise outside training, even if its algorithm says otherwise."""

    @property
    def noise(self) -> Noise:
        """The exploration noise of the policy."""
        return self.algorithm.noise(self.env.discrete)

    @property
    def greedy(self) -> bool:
        """Whether the policy acts without noise outside training."""
        return self.deterministic or self.algorithm.greedy(self.env.discrete)

    @property
    def noise_size(self) -> int:
        """Numbers of noise for an agent's action."""
        return self.env.action_size + (self.noise is Noise.UNIFORM)

    @property
    def of_state(self) -> bool:
        """Whether credit is judged from the global state: one row for each step and team."""
        return self.judged_from == "state"

    @property
    def judged_rows(self) -> int:
        """Rows of a step that are judged: one for each agent, or one for each team."""
        return len(self.env.teams) if self.of_state else self.env.agents

    def judged(self, place: int) -> slice:
        """The rows of a team."""
        return slice(place, place + 1) if self.of_state else self.env.teams[place].agents

    @property
    def warmup(self) -> int:
        """Environment steps with random actions before the first update."""
        return getattr(self.hyperparameters, "warmup", 0)

    @property
    def interleaved(self) -> bool:
        """Whether the decoder is updated with every update of the algorithm."""
        return (
            self.algorithm.consumes is not Consumes.ROLLOUTS
            and self.method.descends
            and self.method.fit is not None
            and not self.method.fit.apart
        )

    @property
    def shown(self) -> int:
        """Size of the observation or of the global state that is judged."""
        return self.env.state_size if self.of_state else self.env.observation_size

    @property
    def entries(self) -> int:
        """The number of raw entries in a team's decoder's input for a judged row."""
        action = self.env.action_size * (self.env.agents if self.of_state else 1)
        match self.method.encoder:
            case None | Encoder.LATENT:
                return 0
            case Encoder.RAW:
                return 2 * self.shown + action if self.raw_differences else self.shown
            case Encoder.JUDGED | Encoder.LATENT_AND_JUDGED:
                return self.shown * len(judged_states(self.judges, 0, 1)) + action
            case _:
                return self.shown + action

    @property
    def bases(self) -> tuple[Basis, ...]:
        """The input of each team's decoder for a judged row, and the features that a closed-form decoder computes from it."""
        extended = self.method.decoder is Decoder.ADDITIVE
        factors = self.factors if self.method.latent else (0,) * len(self.env.teams)
        return tuple(Basis(size, self.entries, extended) for size in factors)

    @property
    def forms(self) -> tuple[int, ...]:
        """Which forms of the score are fitted."""
        looked_for = "score" in self.method.settings and all(basis.size for basis in self.bases)
        return forms_of(self.credit, self.env.fixed_length) if looked_for else (SUM,)

    @property
    def raw_differences(self) -> bool:
        """Whether raw features are [s, a, s - s'], as published for a single agent."""
        return self.method.encoder is Encoder.RAW and self.env.agents == 1 and not self.of_state

    @property
    def columns(self) -> dict[str, jax.ShapeDtypeStruct]:
        """The columns of a row of the replay: those that the algorithm and the decoder read, and no others."""
        env, consumes = self.env, self.algorithm.consumes
        stored = consumes is not Consumes.ROLLOUTS
        encoder = self.method.encoder
        raw = encoder not in (None, Encoder.LATENT)
        wanted = {
            "observation": stored or (raw and not self.of_state),
            "action": stored or (raw and encoder is not Encoder.RAW) or self.raw_differences,
            "factors": self.method.latent,
            "reward": True,
            "state": env.state_size > 0 and ((raw and self.of_state) or consumes is Consumes.SEQUENCES),
            "available": env.masks_actions and consumes is Consumes.SEQUENCES,
            "alive": env.agents_leave,
            "terminated": consumes is Consumes.TRANSITIONS,
        }
        shapes: dict[str, tuple[tuple[int, ...], type]] = {
            "observation": ((env.agents, env.observation_size), np.float32),
            "action": ((env.agents, env.action_size), np.float32),
            "factors": ((self.judged_rows, max(self.factors, default=0)), np.float32),
            "reward": ((env.agents,), np.float32),
            "state": ((env.state_size,), np.float32),
            "available": ((env.agents, env.action_size), np.bool_),
            "alive": ((env.agents,), np.bool_),
            "terminated": ((), np.bool_),
        }
        return {name: jax.ShapeDtypeStruct(*shapes[name]) for name, there in wanted.items() if there}

"""The registry of reinforcement learning algorithms, built-in ones and plugins.

An algorithm is one package or one file: its settings, its update, and a call of `register_algorithm`. `Algorithm.module` names the
module of its functions, which is imported when the algorithm is first used. The training loop calls these functions:

    TRANSITIONS    init, get_actor, act, explore, update                  as in `td3/td3.py`
    ROLLOUTS       init, get_actor, act, explore, update                  as in `ppo/ppo.py`
    SEQUENCES      init, get_actor, act, init_memory, epsilon, update     as in `qmix/qmix.py`

`update` returns the new state and metrics. Metrics whose names begin with `actor/` or `critic/` say that the policy was updated, and
`critic/loss` must be finite.

`lare-rl export` also writes the result of `logits(actor, observation, available)`, if the module has this function.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module
from typing import TYPE_CHECKING, Any

from lare_rl.errors import CheckedModel, Count, LareError
from lare_rl.util.plugins import Registry

if TYPE_CHECKING:  # importing NumPy takes longer than all else that the command line does before it shows a message
    from lare_rl.envs.interface import EnvSpec

__all__ = [
    "ALGORITHMS",
    "Algorithm",
    "AlgorithmSettings",
    "Consumes",
    "Noise",
    "SequenceSettings",
    "register_algorithm",
]


class AlgorithmSettings(CheckedModel):
    """The base class of an algorithm's hyperparameters."""

    @property
    def unused_names(self) -> tuple[str, ...]:
        """The names of hyperparameters that make no difference because of the values of others."""
        return ()


class SequenceSettings(AlgorithmSettings):
    """The base class of the hyperparameters of an algorithm that consumes whole episodes."""

    batch_size: Count = 128
    """Episodes in one update."""
    update_every: Count = 8
    """New episodes for each update."""
    target_every: Count = 200
    """Episodes between two copies to the target networks, each after an update."""


class Consumes(StrEnum):
    """The data that an update of an algorithm reads."""

    TRANSITIONS = "transitions"
    """Single steps from a replay of past steps."""
    ROLLOUTS = "rollouts"
    """The newest steps, collected by the newest policy."""
    SEQUENCES = "sequences"
    """Whole episodes from a replay."""


class Noise(StrEnum):
    """The distribution of the exploration noise. Each entry of an action has an independent number."""

    NORMAL = "normal"
    GUMBEL = "gumbel"
    """The choice with the largest logit plus noise is a sample from the softmax."""
    UNIFORM = "uniform"
    """In [0, 1). A further number for each agent decides whether it explores."""


@dataclass(frozen=True)
class Algorithm:
    """A name with its hyperparameters, and what the algorithm can do.

    Several names may share a module and differ only in their hyperparameters: `ddpg` is TD3 with one critic and without delay.
    """

    name: str
    consumes: Consumes
    settings: AlgorithmSettings
    """The published hyperparameters."""
    module: str
    """The module with the functions that the training loop calls (see above)."""
    run_defaults: "Callable[[EnvSpec, int | None], dict[str, Any]]"
    """Maps an environment, and the number of its copies if the user chose one, to the defaults of `Settings` by name.
    `evaluate_iterations` may stand for `evaluate_every`, and counts iterations. `credit` holds only the settings that differ from
    `MULTI_AGENT_CREDIT` (if `multi_agent`) or from `CreditSettings()`."""
    summary: str
    source: str
    continuous: bool = True
    """Whether it supports continuous actions."""
    discrete: bool = True
    """Whether it supports discrete actions."""
    single_agent: bool = True
    """Whether it trains a single agent."""
    multi_agent: bool = False
    """Whether it trains many agents."""
    multi_team: bool = False
    """Whether it trains several teams, each on its own rewards."""

    def load(self) -> Any:
        """Import and return the module of its functions."""
        return import_module(self.module)

    def noise(self, discrete: bool) -> Noise:
        """Return the distribution of the exploration noise for continuous or discrete actions."""
        if self.consumes is Consumes.SEQUENCES:
            return Noise.UNIFORM
        return Noise.GUMBEL if discrete else Noise.NORMAL

    def deterministic_evaluation(self, discrete: bool, n_agents: int) -> bool:
        """Return whether a policy acts without noise outside training.

        A policy that is trained on rollouts is a distribution. Until it is nearly deterministic, its mode can earn far less than its
        samples. Only the continuous actions of a single agent are taken at the mode.
        """
        return self.consumes is not Consumes.ROLLOUTS or not (discrete or n_agents > 1)


ALGORITHMS = Registry[Algorithm]("algorithm")


def register_algorithm(algorithm: Algorithm) -> None:
    """Add an algorithm. Its name then works in `Settings(algorithm=...)` and on the command line.

    Raises `LareError` if another algorithm has this name, if its settings or `consumes` are of the wrong class, or if it promises what no
    algorithm that consumes such data can do.
    """
    from lare_rl.algorithms.off_policy import OffPolicySettings  # here, because that module imports this one

    if not isinstance(algorithm.consumes, Consumes):
        raise LareError(
            f"algorithm {algorithm.name}: consumes is {algorithm.consumes!r}: pass a member of lare_rl.algorithms.registry.Consumes"
        )
    bases = {Consumes.TRANSITIONS: OffPolicySettings, Consumes.SEQUENCES: SequenceSettings}
    base = bases.get(algorithm.consumes, AlgorithmSettings)
    if not isinstance(algorithm.settings, base):
        raise LareError(
            f"algorithm {algorithm.name}: the settings of an algorithm that consumes {algorithm.consumes} derive from "
            f"{base.__module__}:{base.__name__}: pass an instance of such a class"
        )
    trains = f"algorithm {algorithm.name}: one that consumes {algorithm.consumes} trains"
    if algorithm.consumes is Consumes.TRANSITIONS and (algorithm.discrete or algorithm.multi_agent):
        raise LareError(f"{trains} one agent with continuous actions: pass discrete=False, multi_agent=False")
    if algorithm.consumes is Consumes.SEQUENCES and algorithm.continuous:
        raise LareError(f"{trains} discrete actions: pass continuous=False")
    if algorithm.consumes is not Consumes.ROLLOUTS and algorithm.multi_team:
        raise LareError(f"{trains} one team: pass multi_team=False")
    ALGORITHMS.register(algorithm.name, algorithm)

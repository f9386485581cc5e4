"""The static configuration of a run's compiled functions: `CreditConfig`, and with an algorithm `TrainConfig`."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np

from lare_rl.algorithms.registry import ALGORITHMS, Algorithm, AlgorithmSettings, Consumes, Noise
from lare_rl.config.effective import fits_separately, reads_old_steps
from lare_rl.config.settings import ResolvedSettings
from lare_rl.credit.decoder_settings import RECENT_STEPS, CreditSettings
from lare_rl.credit.input_names import N_EXTREMES, NOT_RAW
from lare_rl.credit.methods import METHODS, Method
from lare_rl.credit.spec import CreditSpec
from lare_rl.data.replay import required_capacity
from lare_rl.envs.interface import EnvSpec
from lare_rl.envs.placement import load_env_spec
from lare_rl.latent.function import LatentFunction
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule
from lare_rl.tasks.spec import CreditScope, ScoredObservation, TaskSpec
from lare_rl.util.rounding import round_up

__all__ = ["CreditConfig", "TrainConfig", "make_train_config", "replay_rows"]


@dataclass(frozen=True, kw_only=True)
class CreditConfig:
    """What credit is assigned to, and how: all that the decoders, their inputs and the replay follow from."""

    env: EnvSpec
    credit_scope: CreditScope = "observation"
    scored_observation: ScoredObservation
    method: Method
    credit: CreditSettings
    scale_rewards: bool
    """Divide the rewards that the algorithm sees by the running root mean square of R/T."""
    n_factors: tuple[int, ...]
    """The number of factors of each team's latent function; empty for a method that needs none, or before it is chosen."""
    n_envs: int
    """The number of environments that each seed collects from."""
    rollout_steps: int
    """Steps of each environment in an iteration."""
    capacity: int
    """Rows of the replay for each environment."""
    fit_updates: int
    """Updates of the decoder in an iteration that fits it. Unused if the decoder is updated with every update of the
    algorithm."""
    consumes: Consumes
    """What the updates of the policy read. If it is only the newest steps, the replay holds what the decoders read, and no more."""
    masks_steps: bool = False
    """Whether decoders leave out single steps of an agent, as if it had left (`pure_credit`)."""
    vectorized: bool = False
    """Whether several fits are computed in one `vmap`, as on an accelerator. It changes their last bits.

    On a CPU this is never faster by much. Besides, batched calls of LAPACK that run at the same time may wait for each other for ever
    (jaxlib 0.10, `ParallelBatchMap`)."""
    payments: PaymentRule = PAID_AT_END
    """When the environment pays."""
    group: str | None = None
    """The measure that tells the level of an episode."""

    @property
    def team_level(self) -> bool:
        """Whether credit goes to whole teams, by the global state: one proxy reward for each step and team."""
        return self.credit_scope == "state"

    @property
    def n_proxy_rewards(self) -> int:
        """The number of proxy rewards of a step: one for each agent, or one for each team."""
        return len(self.env.teams) if self.team_level else self.env.n_agents

    def team_slice(self, team_index: int) -> slice:
        """Return which of a step's proxy rewards belong to a team."""
        return slice(team_index, team_index + 1) if self.team_level else self.env.teams[team_index].agents

    @property
    def iteration_steps(self) -> int:
        """Environment steps of a seed in an iteration."""
        return self.rollout_steps * self.n_envs

    @property
    def longest_segment(self) -> int:
        """The largest number of steps that a payment is for: `max_steps`, if an episode is paid once, at its end."""
        return self.payments.longest_segment(self.env.max_steps)

    @property
    def is_exact(self) -> bool:
        """Whether the proxy rewards of an episode are corrected to add up to its return."""
        return self.credit_specs[0].is_exact

    @property
    def has_fixed_segments(self) -> bool:
        """Whether all payments are for the same number of steps."""
        return self.env.fixed_length and self.payments.is_regular(self.env.max_steps)

    @property
    def n_tracked(self) -> int:
        """The number of entries of a row whose history is stored; 0 for a method that does not read it."""
        return max(spec.basis.n_tracked for spec in self.credit_specs)

    @cached_property
    def credit_specs(self) -> tuple[CreditSpec, ...]:
        """What is fitted to the returns of each team."""
        env = self.env
        return tuple(
            CreditSpec(
                method=self.method,
                settings=self.credit,
                n_factors=n_factors,
                observation_size=env.state_size if self.team_level else env.observation_size,
                action_size=env.action_size * (env.n_agents if self.team_level else 1),
                scored_observation=self.scored_observation,
                single_agent=env.n_agents == 1 and not self.team_level,
                agents=1 if self.team_level else team.n_agents,
                max_steps=self.longest_segment,
                payments=self.payments,
                has_groups=self.group is not None,
                fixed_length=self.has_fixed_segments,
                scale_rewards=self.scale_rewards,
            )
            for team, n_factors in zip(env.teams, self.n_factors or (0,) * len(env.teams), strict=True)
        )

    @property
    def columns(self) -> dict[str, jax.ShapeDtypeStruct]:
        """The columns of a row of the replay: what the algorithm and the decoder read, and no more."""
        env, consumes = self.env, self.consumes
        is_replayed = consumes is not Consumes.ROLLOUTS
        inputs = self.credit_specs[0].inputs
        has_raw_features = any(name not in NOT_RAW for name in inputs)
        observed = (env.n_agents, env.observation_size)
        actions = (env.n_agents, env.action_size)
        factors = (self.n_proxy_rewards, max(self.n_factors, default=0))
        reads_state = consumes is Consumes.SEQUENCES or (has_raw_features and self.team_level)
        columns = {
            "observation": (is_replayed or (has_raw_features and not self.team_level), observed, np.float32),
            "action": (is_replayed or "action" in inputs, actions, np.float32),
            "factors": (self.method.needs_phi, factors, np.float32),
            "history": (self.n_tracked > 0, (self.n_proxy_rewards, N_EXTREMES, self.n_tracked), np.float32),
            "reward": (True, (env.n_agents,), np.float32),
            "state": (env.state_size > 0 and reads_state, (env.state_size,), np.float32),
            "available": (env.masks_actions and consumes is Consumes.SEQUENCES, actions, np.bool_),
            "alive": (env.agents_leave or self.masks_steps, (env.n_agents,), np.bool_),
            "terminated": (consumes is Consumes.TRANSITIONS, (), np.bool_),
        }
        return {name: jax.ShapeDtypeStruct(shape, dtype) for name, (stored, shape, dtype) in columns.items() if stored}


@dataclass(frozen=True, kw_only=True)
class TrainConfig(CreditConfig):
    """What is trained, and how."""

    algorithm: Algorithm
    hyperparameters: AlgorithmSettings
    steps: int
    """Environment steps of the whole run."""
    fit_every: int = 1
    """The decoder makes updates of its own in each iteration whose number is a multiple of this."""
    held_out_first_fit: bool = False
    """Whether the first of these fits lasts until it brings no improvement on held-out episodes."""
    resets_with_steps: bool = False
    """Reset all environments with each step, and use the result where an episode has ended."""
    n_devices: int = 1
    """The number of devices over which the seeds are spread (`seed_axis.py`)."""
    deterministic: bool | None = None
    """Whether a policy acts without noise outside training. None: its algorithm decides."""

    @property
    def noise(self) -> Noise:
        """The exploration noise of the policy."""
        return self.algorithm.noise(self.env.discrete)

    @property
    def deterministic_evaluation(self) -> bool:
        """Whether the policy acts without noise outside training."""
        if self.deterministic is not None:
            return self.deterministic
        return self.algorithm.deterministic_evaluation(self.env.discrete, self.env.n_agents)

    @property
    def noise_size(self) -> int:
        """Numbers of noise for an agent's action."""
        return self.env.action_size + (self.noise is Noise.UNIFORM)

    @property
    def warmup(self) -> int:
        """Environment steps with random actions before the first update: whole iterations."""
        return round_up(getattr(self.hyperparameters, "warmup", 0), self.iteration_steps)

    @property
    def joint_fit(self) -> bool:
        """Whether the decoder is updated with every update of the algorithm."""
        return self.method.uses_gradient and not self.fits_separately

    @property
    def fits_separately(self) -> bool:
        """See `fits_separately` of `config/effective.py`."""
        return fits_separately(self.method, self.consumes)

    @property
    def has_first_fit(self) -> bool:
        """Whether the decoder has a first fit that lasts until it brings no improvement."""
        return self.fits_separately and self.held_out_first_fit


def make_train_config(
    task: TaskSpec, settings: ResolvedSettings, functions: Sequence[LatentFunction] = (), n_devices: int = 1
) -> TrainConfig:
    """Return the static configuration of a run. `functions` are the latent functions of its teams, if they are chosen already."""
    env, algorithm = load_env_spec(task), ALGORITHMS[settings.algorithm]
    scored_observation = settings.choose_scored_observation(task)
    return TrainConfig(
        env=env,
        credit_scope=task.credit_scope,
        scored_observation=scored_observation,
        method=METHODS.find(settings.method),
        credit=settings.credit,
        scale_rewards=settings.scale_rewards,
        n_factors=tuple(function.n_factors(scored_observation) for function in functions),
        n_envs=settings.environments,
        rollout_steps=settings.rollout_steps,
        capacity=replay_rows(settings, env.max_steps),
        fit_updates=settings.fit_updates,
        consumes=algorithm.consumes,
        payments=task.payment_rule,
        group=task.group,
        algorithm=algorithm,
        hyperparameters=settings.hyperparameters,
        steps=settings.steps,
        fit_every=settings.fit_every,
        held_out_first_fit=settings.first_fit == "held-out",
        n_devices=n_devices,
    )


def replay_rows(settings: ResolvedSettings, max_steps: int) -> int:
    """Return the rows of the replay for each environment. An episode has up to `max_steps` steps."""
    required = required_capacity(settings.rollout_steps, max_steps)
    rows = settings.capacity // settings.environments
    if not reads_old_steps(settings):  # only to compare the newest rewards with the true ones
        rows = required + RECENT_STEPS // settings.environments
    max_rows = 2 * settings.steps // settings.environments + 2  # if every episode has one step, which takes two rows
    return min(rows, max(required, max_rows))

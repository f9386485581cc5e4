"""Sampled steps of each team of a run."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float

from lare_rl.envs.interface import Team
from lare_rl.envs.play import phi_inputs
from lare_rl.evaluation.rollout import roll_out
from lare_rl.runs.directory import Run
from lare_rl.util.statistics import column_correlations

__all__ = ["N_SAMPLE_EPISODES", "TeamSample", "sample_steps"]

N_SAMPLE_EPISODES = 40


@dataclass(frozen=True, kw_only=True)
class TeamSample:
    """Steps of one team, over some episodes of the first seed's policy. A row is a step of an agent or, for a state, of the team."""

    team: Team
    next_observation: Float[np.ndarray, "rows observation"]
    """Each agent's observation after the step, or the state."""
    factors: Float[np.ndarray, "rows factors"]
    reward: Float[np.ndarray, " rows"]
    """The true reward."""

    @property
    def correlations(self) -> Float[np.ndarray, " factors"]:
        """Pearson's correlation of each factor with the true reward. NaN if one of the two never varies."""
        return column_correlations(self.factors, self.reward)


def sample_steps(run: Run, random: bool = False) -> list[TeamSample]:
    """Sample steps of each team, under the first seed's policy or under random actions."""
    rollout = roll_out(run, N_SAMPLE_EPISODES, random=random, key=1)
    config, steps, samples = rollout.config, jax.tree.map(np.asarray, rollout.steps), []
    for team_index, team in enumerate(config.env.teams):
        observation, _ = phi_inputs(config.credit_scope, team, steps.next_timestep, steps.env_action)
        mask = np.broadcast_to(rollout.mask[..., None], observation.shape[:-1])
        reward = rollout.reward[..., team.agents]
        if config.team_level:
            reward = reward.mean(axis=-1, keepdims=True)
        else:
            mask = mask & steps.timestep.alive[..., team.agents]
        n_factors = config.n_factors[team_index] if config.n_factors else 0
        factors = rollout.factors[..., config.team_rows(team_index), :n_factors]
        samples.append(
            TeamSample(team=team, next_observation=observation[mask], factors=factors[mask], reward=reward[mask])
        )
    return samples

"""For runs of many agents: sampled steps of each team, and matches between teams of two runs."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from lare_rl.envs.families import make_env
from lare_rl.envs.interface import JaxEnv, Team, team_mean
from lare_rl.envs.play import rows_of
from lare_rl.errors import LareError
from lare_rl.evaluation.episode_credit import correlations
from lare_rl.evaluation.watch import Watched, watch
from lare_rl.runs.directory import Run
from lare_rl.training.collect_device import play
from lare_rl.training.compiled import acting, module_of
from lare_rl.training.session import load_learner
from lare_rl.training.static_config import TrainConfig

SAMPLED = 40
"""Episodes of a sample."""


@dataclass(frozen=True)
class Sample:
    """Judged steps of one team, over some episodes of the first seed's policy."""

    team: Team
    observation: Float[np.ndarray, "rows observation"]
    """What the environment shows after the step: each agent's observation, or the state."""
    factors: Float[np.ndarray, "rows factors"]
    reward: Float[np.ndarray, " rows"]
    """The true reward."""

    @property
    def correlations(self) -> Float[np.ndarray, " factors"]:
        """Pearson's correlation of each factor with the true reward; NaN if one of the two never varies."""
        return correlations(self.factors, self.reward)


def frames(run: Run, watched: Watched) -> list[UInt8[np.ndarray, "height width 3"]] | None:
    """One episode as pictures that show each agent's credit; None for an environment that cannot be drawn."""
    env = make_env(run.config.task)
    if not isinstance(env, JaxEnv):
        env.close()
        return None
    length = int(watched.mask[:, 0].sum())
    states = jax.tree.map(lambda leaf: leaf[:length, 0], watched.state)
    return env.frames(states, watched.of_episode(watched.credit))


def sample(run: Run, random: bool = False) -> list[Sample]:
    """Steps of each team, under the first seed's policy, or under random actions."""
    watched = watch(run, SAMPLED, random, key=1)
    config, steps, found = watched.config, watched.steps, []
    after, taken = jax.tree.map(np.asarray, (steps.after, steps.taken))
    for place, team in enumerate(config.env.teams):
        rows, _ = rows_of(config.judged_from, team, after, taken)
        mask = np.broadcast_to(watched.mask[..., None], rows.shape[:-1])
        reward = watched.reward[..., team.agents]
        if config.of_state:
            reward = reward.mean(axis=-1, keepdims=True)
        else:
            mask = mask & np.asarray(steps.before.alive)[..., team.agents]
        size = config.factors[place] if config.factors else 0
        factors = watched.factors[..., config.judged(place), :size]
        found.append(Sample(team, rows[mask], factors[mask], reward[mask]))
    return found


class Match(NamedTuple):
    """The first team of one run against the second team of another: the first team's return, for each pair of seeds."""

    first: Run
    others: Run
    returns: Float[np.ndarray, "seeds other_seeds"]


def cross_play(runs: tuple[Run, Run], episodes: int = 200) -> list[Match]:
    """Let the first team of each run play against the second team of each: four matches, all from the same initial states.

    Raises:
        LareError: the runs are not of one task with two teams, or `episodes` is less than 1.
    """
    if episodes < 1:
        raise LareError(f"episodes = {episodes}: at least one is needed")
    names = {run.config.task.name for run in runs}
    if len(names) > 1 or len(runs[0].config.task.teams) != 2:
        raise LareError(
            f"cross-play needs two runs of one task in which two teams learn, and these are of {', '.join(sorted(names))}"
        )
    env = make_env(runs[0].config.task)
    if not isinstance(env, JaxEnv):
        env.close()
        raise LareError(f"cross-play is for environments in JAX, and {runs[0].config.task.name} steps on the host")
    loaded = [load_learner(run)[:2] for run in runs]
    total = jax.jit(partial(first_teams_return, env, episodes=episodes, config=loaded[0][0]))

    def actors(place: int) -> list[Any]:
        config, learner = loaded[place]
        every = module_of(config).actor(learner, runs[place].config.settings.steps, config)
        return [
            jax.tree.map(lambda leaf, seed=seed: leaf[seed : seed + 1], every) for seed in range(len(runs[place].seeds))
        ]

    matches = []
    for ours, first in enumerate(runs):
        for theirs, others in enumerate(runs):
            returns = [
                [float(total(one, other, jax.random.key(0))) for other in actors(theirs)] for one in actors(ours)
            ]
            matches.append(Match(first, others, np.array(returns)))
    return matches


def first_teams_return(
    env: JaxEnv, ours: Any, theirs: Any, key: PRNGKeyArray, episodes: int, config: TrainConfig
) -> Float[Array, ""]:
    """The mean over episodes of the first team's return R. One policy controls this team, another one all other agents."""
    team = config.env.teams[0]
    act = partial(led_by_two, act=acting(config, greedy=False), team=team)
    played = play(env, (ours, theirs), key[None], episodes, config, greedy=False, act=act)
    reward = team_mean(played.steps.after.reward, played.steps.before.alive, team)
    return jnp.mean(jnp.sum(reward * played.mask, axis=0))


def led_by_two(
    actors: tuple[Any, Any], memory: Any, *shown: Any, act: Any, team: Team
) -> tuple[Float[Array, "seeds envs agents action"], Any]:
    """The first team's actions by one actor, all other actions by the other actor. Neither has a memory."""
    first, others = (act(actor, memory, *shown)[0] for actor in actors)
    return jnp.where((jnp.arange(first.shape[-2]) < team.stop)[:, None], first, others), memory

"""Small configurations, and random steps, to test the parts of training on (`from helpers.small_configs import ...`)."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.algorithms.ppo import PPOSettings
from lare_rl.algorithms.qmix import QMIXSettings
from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.algorithms.td3 import TD3Settings
from lare_rl.config.train_config import TrainConfig
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.linear_decoder import LinearDecoder
from lare_rl.credit.methods import METHODS
from lare_rl.data import replay
from lare_rl.data.replay import STEP_COLUMNS
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import EnvSpec, Team, Timestep, to_env_action
from lare_rl.training import learner as learners
from lare_rl.training.episodes import learn_returns
from lare_rl.training.policy import init_algorithm

LENGTHS = (5, 12, 3, 9, 12)
"""The lengths of the episodes of one environment. The next environments have them in another order."""

TOTAL = sum(LENGTHS)

ONE_AGENT = EnvSpec(
    (Team("agent", 0, 1),), 3, 2, False, 12, low=np.full((1, 2), -1, np.float32), high=np.ones((1, 2), np.float32)
)
ONE_TEAM = EnvSpec((Team("all", 0, 3),), 3, 4, True, 12, state_size=5, agents_leave=True, masks_actions=True)
"""Three agents with discrete actions, some of whom leave."""
TWO_TEAMS = EnvSpec((Team("first", 0, 3), Team("second", 3, 5)), 3, 4, True, 12, agents_leave=True, masks_actions=True)

SMALL_SETTINGS = {
    "td3": TD3Settings(hidden=(8,), batch_size=8, warmup=0),
    "ppo": PPOSettings(
        hidden=(8,), minibatch_size=5, epochs=2, entropy_coef=0.0, anneal=False, normalise_observations=True
    ),
    "ippo": PPOSettings(hidden=(8,), minibatch_size=50, epochs=1, entropy_coef=0.0, anneal=False),
    "qmix": QMIXSettings(hidden=4, embed=2, hypernet=3, batch_size=4, update_every=2, target_every=4),
}


SUM_CREDIT = CreditSettings(hidden=(8,), sampled_steps=4, batch_steps=24, score="sum")
"""Nothing is fitted to find out the type of the score, which takes seconds to compile."""
ANY_SCORE = SUM_CREDIT.model_copy(update={"score": "auto"})


def small_config(method, algorithm="td3", env=ONE_AGENT, **changes):
    values = {
        "env": env,
        "credit_scope": "observation",
        "method": METHODS[method],
        "consumes": ALGORITHMS[algorithm].consumes,
        "algorithm": ALGORITHMS[algorithm],
        "hyperparameters": SMALL_SETTINGS.get(algorithm),
        "credit": SUM_CREDIT,
        "scale_rewards": False,
        "n_factors": tuple(2 + i for i in range(len(env.teams))) if METHODS[method].needs_phi else (),
        "scored_observation": "after",
        "n_envs": 1,
        "rollout_steps": 4,
        "capacity": 100,
        "steps": 100,
        "fit_updates": 1,
    }
    return TrainConfig(**(values | changes))


def random_steps(env=ONE_AGENT, envs=1, seed=0, lengths=LENGTHS):
    """Return random steps of whole episodes that are all truncated. An agent that leaves is gone until the end."""
    random, total = np.random.default_rng(seed), sum(lengths)
    lead, agents = (total, envs), env.n_agents

    def normal(*shape):
        return random.normal(size=(*lead, *shape)).astype(np.float32)

    ended, alive = np.zeros(lead, bool), np.ones((*lead, agents), bool)
    next_alive = alive.copy()
    for i in range(envs):
        ends = np.cumsum(np.roll(lengths, i))
        ended[ends - 1, i] = True
        for start, end in zip([0, *ends], ends, strict=False):
            for agent in range(agents if env.agents_leave else 0):
                leaves = start + random.integers(1, 2 * (end - start) + 1)  # half of them stay
                alive[leaves:end, i, agent] = next_alive[leaves - 1 : end - 1, i, agent] = False
    observation, state = normal(agents, env.observation_size), normal(env.state_size)
    final = normal(agents, env.observation_size), normal(env.state_size)
    observation *= alive[..., None]

    def shift(values, final):
        is_last = ended.reshape(*lead, *[1] * (values.ndim - 2))
        return np.where(is_last, final, np.roll(values, -1, axis=0))

    next_observation, next_state = shift(observation, final[0]) * next_alive[..., None], shift(state, final[1])
    available = np.ones((*lead, agents, env.action_size), bool)
    if env.masks_actions:
        available = random.uniform(size=available.shape) < 0.6
        available[..., 0] |= ~available.any(axis=-1)
    action = 2 * normal(agents, env.action_size)  # some actions are beyond the bounds
    if env.discrete:
        action = to_env_action(np.where(available, action, -np.inf), env)
    never = np.zeros(lead, bool)
    timestep = Timestep(
        observation=observation,
        state=state,
        available=available,
        alive=alive,
        reward=np.zeros((*lead, agents), np.float32),
        terminated=never,
        truncated=never,
        measures={},
    )
    next_timestep = Timestep(
        observation=next_observation,
        state=next_state,
        available=np.where(ended[..., None, None], True, np.roll(available, -1, axis=0)),
        alive=next_alive,
        reward=normal(agents) * alive,
        terminated=never.copy(),
        truncated=ended,
        measures={},
    )
    return Trajectory(timestep, action, to_env_action(action, env), next_timestep)


def with_other_dead_values(steps):
    """Return the steps with other observations, actions and rewards of agents that have left."""
    dead = ~steps.timestep.alive
    # The next observation of an agent's last step still counts.
    long_dead = dead & np.roll(dead, 1, axis=0) & ~np.roll(steps.ended, 1, axis=0)[..., None]
    assert 0.1 < dead.mean() < 0.5
    assert long_dead.any()
    return steps._replace(
        timestep=steps.timestep._replace(observation=np.where(long_dead[..., None], 99, steps.timestep.observation)),
        next_timestep=steps.next_timestep._replace(
            observation=np.where(dead[..., None], 99, steps.next_timestep.observation),
            reward=np.where(dead, 99, steps.next_timestep.reward),
        ),
        action=np.where(dead[..., None], np.eye(4, dtype=np.float32)[0], steps.action),
    )


def random_factors(config, steps):
    """Return random factors of every row."""
    shape = (*steps.ended.shape, config.n_proxy_rewards, max(config.n_factors, default=0))
    return np.random.default_rng(1).normal(size=shape).astype(np.float32)


def untrained_learner(config):
    """Return an untrained learner. It is not compiled: single operations are shared by all configurations."""
    return learners.init_learner(jax.random.key(0), config, partial(init_algorithm, config=config))


def steps_as_stored(config, steps):
    """Return the columns of the first environment's steps as `stored_steps` does, without a replay and its other fields."""
    timestep, next_timestep = (
        {name: getattr(timestep, name)[:, 0] for name in STEP_COLUMNS}
        for timestep in (steps.timestep, steps.next_timestep)
    )
    columns = timestep | {
        "action": steps.action[:, 0],
        "factors": random_factors(config, steps)[:, 0],
        "reward": steps.next_timestep.reward[:, 0],
        "terminated": steps.next_timestep.terminated[:, 0],
    }
    return replay.StoredSteps(
        {name: jnp.asarray(columns[name]) for name in config.columns},
        {name: jnp.asarray(next_timestep[name]) for name in STEP_COLUMNS if name in config.columns},
        *[None] * 7,
    )


def team_rewards(steps, team):
    """Return the team's reward of each step: the mean over its agents that are alive, by a loop."""
    means = []
    for reward, alive in zip(steps.next_timestep.reward[:, 0], steps.timestep.alive[:, 0], strict=True):
        values = [reward[agent] for agent in range(team.start, team.stop) if alive[agent]]
        means.append(np.mean(values) if values else 0.0)
    return np.array(means)


def add_steps(learner, config, steps, factors=None, learn=None):
    """Return a learner that has stored these steps too.

    By default, only decoders in closed form learn from the finished episodes. Other decoders would only learn the type
    of the score, and compiling this takes seconds.
    """
    factors = random_factors(config, steps) if factors is None else factors
    learner = jitted(learners.store_with_factors, config)(learner, steps, factors)
    learns = config.method.fit is not None and (not config.method.uses_gradient if learn is None else learn)
    return learn_stored_returns(learner, config) if learns else learner


def store_seeds(config):
    """Return a function that stores steps and their factors for several seeds."""
    return jax.jit(jax.vmap(partial(learners.store_with_factors, config=config)), donate_argnums=0)


_COMPILED = {}


def jitted(function, config):
    """Return a function for one configuration, compiled once."""
    key = function, repr(config)
    if key not in _COMPILED:
        _COMPILED[key] = jax.jit(partial(function, config=config))
    return _COMPILED[key]


def learn_stored_returns(learner, config):
    """Return a learner whose decoders have learned from all finished episodes."""
    untrained = learner._replace(algorithm=())
    with jax.enable_x64(True):
        learned = jitted(learn_returns, config)(jax.tree.map(lambda leaf: np.asarray(leaf)[None], untrained))
    return jax.tree.map(lambda leaf: leaf[0], learned)._replace(algorithm=learner.algorithm)


def with_factor_decoders(learner, weights):
    """Return the learner with decoders whose output is their only factor, times a weight for each team."""
    decoders = tuple(
        team._replace(
            network=LinearDecoder(team.network.basis, *(jnp.array([x]) for x in (0.0, 1.0, weight)), jnp.zeros(()))
        )
        for team, weight in zip(learner.decoders, weights, strict=True)
    )
    return learner._replace(decoders=decoders)


def learner_with_episodes(config, seed=0):
    """Return a learner with five episodes in each environment."""
    return add_steps(untrained_learner(config), config, random_steps(config.env, config.n_envs, seed))


def stored_steps(learner):
    """Return all stored steps of the first environment, in order."""
    buffer = learner.replay
    number = np.arange(int(replay.oldest_transition(buffer)[0]), int(buffer.next_transition[0]))
    return read(buffer, replay.Index(np.zeros_like(number), number))


read = jax.jit(replay.read)

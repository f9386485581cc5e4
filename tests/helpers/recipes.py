"""Small configurations, and steps that were never taken, to try the parts of training on (`from helpers.recipes import ...`)."""

from functools import partial

import jax
import numpy as np

from lare_rl.algorithms.settings import PPOSettings, QMIXSettings, TD3Settings
from lare_rl.algorithms.table import ALGORITHMS
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.data import replay
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import EnvSpec, Team, Timestep, env_action
from lare_rl.training import learner as common
from lare_rl.training.compiled import module_of
from lare_rl.training.episodes import learn_returns
from lare_rl.training.static_config import TrainConfig

LENGTHS = (5, 12, 3, 9, 12)
"""Of the episodes of one environment; of the next ones, the same in another order."""

TOTAL = sum(LENGTHS)

ALONE = EnvSpec(
    (Team("agent", 0, 1),), 3, 2, False, 12, low=np.full((1, 2), -1, np.float32), high=np.ones((1, 2), np.float32)
)
TOGETHER = EnvSpec((Team("all", 0, 3),), 3, 4, True, 12, state_size=5, agents_leave=True, masks_actions=True)
"""Three agents that choose, some of whom leave."""
RIVALS = EnvSpec((Team("first", 0, 3), Team("second", 3, 5)), 3, 4, True, 12, agents_leave=True, masks_actions=True)

QUICK = {
    "td3": TD3Settings(hidden=(8,), batch_size=8, warmup=0),
    "ppo": PPOSettings(hidden=(8,), minibatch_size=5, epochs=2, normalise_observations=True),
    "ippo": PPOSettings(hidden=(8,), minibatch_size=50, epochs=1),
    "qmix": QMIXSettings(hidden=4, embed=2, hypernet=3, batch_size=4, update_every=2, target_every=4),
}


def config_of(method, algorithm="td3", env=ALONE, **changes):
    values = {
        "env": env,
        "judged_from": "observation",
        "method": METHODS[method],
        "algorithm": ALGORITHMS[algorithm],
        "hyperparameters": QUICK[algorithm],
        "credit": CreditSettings(hidden=(8,), drawn_steps=4, steps=24),
        "scale_rewards": False,
        "factors": tuple(2 + place for place in range(len(env.teams))) if METHODS[method].latent else (),
        "judges": "after",
        "environments": 1,
        "rollout_steps": 4,
        "capacity": 100,
        "steps": 100,
        "fit_updates": 1,
    }
    return TrainConfig(**(values | changes))


def steps_of(env=ALONE, envs=1, seed=0, lengths=LENGTHS):
    """Random steps of whole episodes, all of which run out of time; who leaves is gone until the end."""
    random, total = np.random.default_rng(seed), sum(lengths)
    lead, agents = (total, envs), env.agents

    def normal(*shape):
        return random.normal(size=(*lead, *shape)).astype(np.float32)

    ended, alive = np.zeros(lead, bool), np.ones((*lead, agents), bool)
    stays = alive.copy()
    for place in range(envs):
        ends = np.cumsum(np.roll(lengths, place))
        ended[ends - 1, place] = True
        for begin, end in zip([0, *ends], ends, strict=False):
            for agent in range(agents if env.agents_leave else 0):
                gone = begin + random.integers(1, 2 * (end - begin) + 1)  # half of them stay
                alive[gone:end, place, agent] = stays[gone - 1 : end - 1, place, agent] = False
    observation, state = normal(agents, env.observation_size), normal(env.state_size)
    last = normal(agents, env.observation_size), normal(env.state_size)
    observation *= alive[..., None]
    led_to = []
    for now, end in ((observation, last[0]), (state, last[1])):
        over = ended.reshape(*lead, *[1] * (now.ndim - 2))
        led_to.append(np.where(over, end, np.roll(now, -1, axis=0)))
    led_to[0] *= stays[..., None]
    available = np.ones((*lead, agents, env.action_size), bool)
    if env.masks_actions:
        available = random.uniform(size=available.shape) < 0.6
        available[..., 0] |= ~available.any(axis=-1)
    action = 2 * normal(agents, env.action_size)  # some of them beyond the bounds
    if env.discrete:
        action = env_action(np.where(available, action, -np.inf), env)
    nothing, never = np.zeros((*lead, agents), np.float32), np.zeros(lead, bool)
    before = Timestep(observation, state, available, alive, nothing, never, never, {})
    after = Timestep(
        *led_to,
        np.where(ended[..., None, None], True, np.roll(available, -1, axis=0)),
        stays,
        normal(agents) * alive,
        never.copy(),
        ended,
        {},
    )
    return Trajectory(before, action, env_action(action, env), after)


def factors_for(config, steps, seed=1):
    """Random factors of every judged row."""
    shape = (*steps.ended.shape, config.judged_rows, max(config.factors, default=0))
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def untrained(config, seed=0):
    return jitted(begun, config)(jax.random.key(seed))


def begun(key, config):
    return common.init(key, config, lambda key: module_of(config).init(key, config))


def with_steps(learner, config, steps, factors=None, tell=False):
    """A learner that has met these steps too. Fits in closed form have been told of the episodes that have finished, and all others
    with `tell`: they would only learn the form of the score from it, and compiling this takes a second.
    """
    factors = factors_for(config, steps) if factors is None else factors
    learner = jitted(common.store_with_factors, config)(learner, steps, factors)
    return told(learner, config) if learner.credit and (tell or not config.method.descends) else learner


def store_seeds(config):
    """Stores the steps and factors of several seeds, as `compiled(config).store` does with those that it computes."""
    return jax.jit(jax.vmap(partial(common.store_with_factors, config=config)), donate_argnums=0)


COMPILED = {}


def jitted(function, config):
    """A function for one configuration, compiled once."""
    key = function, repr(config)  # the same for one that is made again
    if key not in COMPILED:
        COMPILED[key] = jax.jit(partial(function, config=config))
    return COMPILED[key]


def told(learner, config):
    """A learner whose decoders have been told of all episodes that have finished."""
    given = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (learner.credit, learner.replay, learner.counted))
    with jax.enable_x64(True):
        learned = jitted(learn_returns, config)(*given)
    credit, counted = jax.tree.map(lambda leaf: leaf[0], learned)
    return learner._replace(credit=credit, counted=counted)


def stored(config, seed=0):
    """A learner that has met five episodes in each environment."""
    return with_steps(untrained(config), config, steps_of(config.env, config.environments, seed))


def every_step(learner):
    """All that is stored of the first environment, in order."""
    held = learner.replay
    number = np.arange(int(replay.oldest_transition(held)[0]), int(held.transitions[0]))
    return read(held, replay.Index(np.zeros_like(number), number))


read = jax.jit(replay.read)


def paid_by(learner):
    return common.Paid(learner.credit, learner.scale)

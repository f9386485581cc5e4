"""Small recipes for runs of a single agent, and a replay of five episodes (`from recipes import ...`)."""

from functools import partial

import jax
import numpy as np

from lare.algorithms.td3 import TD3Settings
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import METHODS, Encoder
from lare.training import learner as common
from lare.training.recipe import Recipe
from lare.training.replay import Step

LENGTHS = (5, 12, 3, 9, 12)


def recipe(method, **changes):
    values = {
        "method": METHODS[method],
        "algorithm": TD3Settings(hidden=(8,), batch_size=8, warmup=0),
        "credit": CreditSettings(hidden=(8,), drawn_steps=4, steps=24),
        "scale_rewards": False,
        "observation_size": 3,
        "action_size": 2,
        "factors": 2 if METHODS[method].encoder is Encoder.LATENT else 0,
        "longest_episode": 12,
        "capacity": 100,
        "discrete": False,
        "steps": 100,
        "turn": 4,
        "fit_updates": 1,
    }
    return Recipe(**(values | changes))


def steps_of(factors):
    rng, total = np.random.default_rng(0), sum(LENGTHS)
    s, a, z, n = (rng.normal(size=(total, size)).astype(np.float32) for size in (3, 2, factors, 3))
    ended = np.zeros(total, bool)
    ended[np.cumsum(LENGTHS) - 1] = True
    return Step(s, a, z, rng.normal(size=total).astype(np.float32), n, np.zeros(total, bool), ended)


def stored(chosen):
    learner = common.init(jax.random.key(0), chosen)
    return jax.jit(partial(common.store, recipe=chosen))(learner, steps_of(chosen.factors))

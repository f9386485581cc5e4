"""The same steps lead to the same decoder and the same r_hat as in the project's own trainer (`lare_rl.training`)."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from helpers.recipes import ALONE, LENGTHS, TOGETHER, config_of, every_step, paid_by, steps_of, untrained, with_steps
from helpers.tiers import long
from helpers.toys import toy_spec
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.credit.methods import METHODS
from lare_rl.training import learner as common

TWO = replace(ALONE, observation_size=2, action_size=1, low=ALONE.low[:, :1], high=ALONE.high[:, :1])
"""The sizes of the toy that `phi` is for. Units are those of the policy: bounds are 1."""
LONG = LENGTHS * 6


def both(method, env, phi=None):
    """A learner of the trainer's and an assigner that have met the same steps, some at a time."""
    judges = "after" if phi is None else toy_spec().judges
    config = config_of(method, "td3" if env.agents == 1 else "ippo", env, capacity=1000, judges=judges)
    many = {} if env.agents == 1 else {"agents": env.agents, "max_steps": env.max_steps}
    credit = CreditAssigner(
        method,
        phi,
        task=None if phi is None else toy_spec(),
        observation_space=env.observation_size,
        action_space=env.action_size,
        settings=config.credit,
        **many,
    )
    learner, steps = untrained(config), steps_of(env, lengths=LONG)
    for rows in np.array_split(np.arange(len(steps.ended)), 12):
        some = jax.tree.map(lambda leaf, rows=rows: leaf[rows], steps)
        parts = [
            part[:, 0] for part in (some.before.observation, some.taken, some.after.observation, some.after.reward)
        ]
        if env.agents == 1:
            parts = [part[:, 0] for part in parts]
        before, action, after, reward = parts
        factors = np.zeros((len(rows), 1, 1, 0), np.float32)
        if phi is not None:
            factors = phi.of_steps(before, action, after, "before")[:, None, None]
        learner = with_steps(learner, config, some, factors if phi is not None else None, tell=True)
        alive = some.before.alive[:, 0] if env.agents > 1 else None
        lanes, never = [0] * len(rows), np.zeros(len(rows), bool)
        credit.add(before, action, after, reward, never, some.ended[:, 0], lanes=lanes, alive=alive)
        credit.rewards_at([])  # the trainer learns after each of these
    return learner, config, credit


CASES = [
    ("lare-bayes", TWO),
    long("lare-linear", TWO),
    long("lare-signs", TWO),
    long("bayes", TWO),
    long("rd-linear", ALONE),
    long("rd-linear", TOGETHER),
    long("lare-rd", TWO),
    long("rd", TOGETHER),
    ("ircr", ALONE),
]


@pytest.mark.parametrize(("method", "env"), CASES)
def test_the_same_steps_lead_to_the_same_credit(method, env, phi):
    learner, config, credit = both(method, env, phi if METHODS[method].latent else None)
    numbers = np.arange(credit.store.steps)
    if credit.learner.state is not None:
        (own,) = learner.credit
        same(credit.learner.state.statistics, own.statistics)
        same(credit.learner.state.scale, own.scale)
        same(credit.learner.state.return_scale, own.return_scale)
        assert int(credit.learner.told) == int(learner.counted.sum())
        assert bool(credit.learner.state.average) == bool(own.average)
    if not METHODS[method].descends:  # whose weights are drawn
        want = np.asarray(common.rewards(every_step(learner), paid_by(learner), config))
        want = want if env.agents > 1 else want[..., 0]
        np.testing.assert_allclose(credit.rewards_at(numbers), want, rtol=1e-4, atol=1e-5 * np.abs(want).max())
        assert np.abs(want).max() > 0


def same(found, wanted):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)

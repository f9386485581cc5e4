"""A toy in JAX, apart from `toy_envs.py`, which workers import without JAX."""

from copy import copy
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp

from lare_rl.envs.families import register_family
from lare_rl.envs.interface import EnvSpec, Team, Timestep
from lare_rl.envs.jax_on_host import JaxOnHost
from lare_rl.tasks.spec import TaskSpec


class EchoState(NamedTuple):
    """The state of `Echo`."""

    step: jax.Array
    length: jax.Array
    stay: jax.Array
    """How many steps each agent stays."""
    cue: jax.Array
    """The action that each agent should repeat now."""


class Echo:
    """A toy of many agents in JAX: an agent that repeats its cue earns 1.

    Episodes have 3 to 6 steps; those of 6 are truncated, the others terminate. Two of three agents may leave before. The last of three
    actions is available at every second step, and agents that have left have only the first.
    """

    spec = EnvSpec(
        (Team("all", 0, 3),),
        observation_size=4,
        action_size=3,
        discrete=True,
        max_steps=6,
        state_size=9,
        agents_leave=True,
        masks_actions=True,
        is_jax=True,
        measures=("right",),
    )

    def reset(self, key):
        cue, length, stay = jax.random.split(key, 3)
        stays = jax.random.randint(stay, (3,), 1, 9).at[0].set(9)
        cues = EchoState(jnp.array(0), jax.random.randint(length, (), 3, 7), stays, self.cue(cue, 0))
        return cues, self.timestep(cues, jnp.zeros(3))

    def cue(self, key, step):
        return jax.random.randint(key, (3,), 0, 2 + step % 2)

    def step(self, state, action, key):
        right = (jnp.argmax(action, axis=-1) == state.cue) & (state.step < state.stay)
        step = state.step + 1
        cues = state._replace(step=step, cue=self.cue(key, step))
        return cues, self.timestep(cues, right.astype(jnp.float32))

    def timestep(self, cues, reward):
        alive = cues.step < cues.stay
        one_hot = jax.nn.one_hot(cues.cue, 3) * alive[:, None]
        odd = jnp.broadcast_to(cues.step % 2 == 1, (3,))
        available = jnp.stack([jnp.ones(3, bool), alive, alive & odd], axis=-1)
        over = cues.step >= cues.length
        return Timestep(
            observation=jnp.concatenate([one_hot, alive[:, None] * cues.step / 6], axis=-1),
            state=one_hot.ravel(),
            available=available,
            alive=alive,
            reward=reward,
            terminated=over & (cues.step < 6),
            truncated=cues.step >= 6,
            measures={"right": reward.sum()},
        )

    def frames(self, states, credit=None):
        return []


def echo_spec(**changes) -> TaskSpec:
    values = {
        "name": "Echo",
        "environment": "echo/three",
        "observation_size": 4,
        "action_size": 3,
        "scored_observation": "before",
        "description": "Do as you are told.",
        "observation": "0 to 2: what to do. 3: the time.",
        "action": "0 to 2: what is done.",
    }
    return TaskSpec(**(values | changes))


HOSTED = JaxOnHost(Echo())
HOSTED.spec = replace(Echo.spec, is_jax=False)


def make_hosted_echo(task, **_):
    """The toy, stepped on the host. All copies share the compiled functions."""
    return copy(HOSTED)


register_family("echo", lambda task, **_: Echo())
register_family("hosted", make_hosted_echo)

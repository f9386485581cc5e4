"""The functions of a run, compiled, with a leading seed axis on every array but the number of steps done."""

from collections.abc import Callable, Sequence
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from lare_rl.algorithms.table import Consumes
from lare_rl.data.trajectory import Trajectory
from lare_rl.phi.graph import Graph
from lare_rl.training import episodes, off_policy, on_policy, sequences
from lare_rl.training import learner as common
from lare_rl.training.learner import Learner
from lare_rl.training.static_config import TrainConfig
from lare_rl.util.float64 import float64

Metrics = dict[str, Float[Array, " seeds"]]


class Compiled(NamedTuple):
    """`store`, `fit` and `improve` consume the learner that they are given: its buffers are reused for the new one."""

    init: Callable[[Key[Array, " seeds"]], Learner]
    """Untrained learners."""
    store: Callable[[Learner, Trajectory], tuple[Learner, Bool[Array, " seeds"]]]
    """From learner and new steps; whether all factors of each seed are finite."""
    learn_returns: Callable[[Learner], Learner]
    """`episodes.learn_returns`, for when episodes have finished."""
    fit: Callable[[Learner, Key[Array, " seeds"]], tuple[Learner, Metrics]]
    """The decoders' own updates; the mean of each metric over them."""
    improve: Callable[..., tuple[Learner, Metrics]]
    """From learner, the newest steps, keys, and the environment steps done before."""
    assess: Callable[[Learner], Metrics]
    actor: Callable[[Learner, int], Any]
    """The parts of the learner that are needed to act."""
    explore: Callable[..., tuple[Float[Array, "seeds envs agents action"], Any]]
    """The policy that collects, from actor, memory, observation, available actions, noise, and which episodes are new."""
    act: Callable[..., tuple[Float[Array, "seeds envs agents action"], Any]]
    """The policy without noise, from the same arguments, with None as the noise."""


def module_of(config: TrainConfig) -> ModuleType:
    """The module for the data that the run's algorithm consumes."""
    match config.algorithm.consumes:
        case Consumes.TRANSITIONS:
            return off_policy
        case Consumes.ROLLOUTS:
            return on_policy
        case Consumes.SEQUENCES:
            return sequences


def new_learners(keys: Key[Array, " seeds"], config: TrainConfig) -> Learner:
    """Untrained learners."""
    module = module_of(config)
    return jax.vmap(lambda key: common.init(key, config, lambda key: module.init(key, config)))(keys)


def new_memory(config: TrainConfig, *lead: int) -> Any:
    """The memory of actors before the first step of an episode, for seeds and environments in `lead`."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*lead, *leaf.shape)), module_of(config).memory(config))


def acting(config: TrainConfig, greedy: bool) -> Callable[..., tuple[Array, Any]]:
    """The policy of all seeds. Its memory is reset where an episode is new."""
    module = module_of(config)

    def act(
        actor: Any,
        memory: Any,
        observation: Array,
        available: Array,
        noise: Array | None,
        new: Bool[Array, " envs"],
    ) -> tuple[Array, Any]:
        def renewed(leaf: Array, first: Array) -> Array:
            return jnp.where(new.reshape(-1, *[1] * (leaf.ndim - 1)), first, leaf)

        memory = jax.tree.map(renewed, memory, module.memory(config))
        return module.act(actor, memory, observation, available, noise, config)

    return jax.vmap(act, in_axes=(0, 0, 0, 0, None if greedy else 0, 0))


def compiled(config: TrainConfig, phi: Sequence[Graph] = ()) -> Compiled:
    """The functions of a run. `phi` holds the graph of each team's phi; only `store` needs it."""
    module = module_of(config)

    def fit_in_turn(learner: Learner, keys: Key[Array, " seeds"]) -> tuple[Learner, Metrics]:
        # One seed after the other, because a large batch of episodes fills the caches already.
        credit, measured = jax.lax.map(lambda one: common.fit_often(one[0], one[1], config), (learner, keys))
        return learner._replace(credit=credit), measured

    learn = jax.jit(partial(episodes.learn_returns, config=config))

    def learn_returns(learner: Learner) -> Learner:
        with float64():
            credit, counted = jax.block_until_ready(learn(learner.credit, learner.replay, learner.counted))
        return learner._replace(credit=credit, counted=counted)

    return Compiled(
        init=jax.jit(partial(new_learners, config=config)),
        learn_returns=learn_returns,
        store=jax.jit(jax.vmap(partial(common.store, config=config, phi=phi)), donate_argnums=0),
        fit=jax.jit(fit_in_turn, donate_argnums=0),
        improve=jax.jit(partial(module.improve, config=config), donate_argnums=0),
        assess=jax.jit(jax.vmap(partial(common.assess, config=config))),
        actor=partial(module.actor, config=config),
        explore=jax.jit(acting(config, greedy=False)),
        act=jax.jit(acting(config, greedy=True)),
    )

"""The scripted prey of the predator-prey tasks: its training by PPO, and its measurement.

    python benchmarks/train_prey.py train        writes src/lare_rl/envs/particles/prey.npz
    python benchmarks/train_prey.py measure      writes benchmarks/results/prey.json

The published tasks ship the weights of a prey that was trained for a quarter of its time, which we may not redistribute. So our
prey learns against greedy predators, each of which moves towards its nearest prey. Its training stops when these predators earn as
much as they do from the published prey: +29.5 in an episode of PP-6, compared with +80.2 from preys that move at random (measured
on the published weights, 300 episodes).
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare_rl.envs.particles import predator_prey, views
from lare_rl.envs.particles.predator_prey import (
    SIZES,
    Layers,
    Size,
    make_world,
    observe_preys,
    reset,
    reward_predators,
    reward_preys,
    sample_actions,
    shipped_prey,
)
from lare_rl.envs.particles.task import MAX_STEPS, N_ACTIONS
from lare_rl.envs.particles.world import State, move, push
from lare_rl.nn.networks import MLP, adam_step, init_adam
from measure import write

TARGET = 29.5
"""The reward of greedy predators against the published prey, summed over predators and steps of a PP-6 episode."""
SHIPPED = Path(predator_prey.__file__).with_name("prey.npz")

WORLDS = 256
PASSES, MINIBATCHES = 4, 4
RATE, CLIP, ENTROPY, DISCOUNT, TRACE = 3e-4, 0.2, 0.01, 0.95, 0.95
REWARD_SCALE = 0.1
LATEST = 5
"""The predators' rewards are averaged over so many iterations, and then compared with TARGET."""


def chase(size: Size, state: State) -> Int[Array, " predators"]:
    """Return the actions of greedy predators, which are used to evaluate preys.

    They move along the axis on which the nearest prey is further away.
    """
    nearest = views.nearest_entities(state.position, size.predators, size.preys, 1)
    x, y = jnp.moveaxis(views.relative_positions(state.position, size.predators, nearest)[:, 0], -1, 0)
    return jnp.where(jnp.abs(x) > jnp.abs(y), jnp.where(x > 0, 2, 1), jnp.where(y > 0, 4, 3))


class Networks(NamedTuple):
    actor: MLP
    critic: MLP


class Samples(NamedTuple):
    """Steps of preys, with the leading axes (world, step, prey), or with these flattened into one."""

    observation: Float[Array, "*lead observation"]
    action: Int[Array, "*lead"]
    log_probability: Float[Array, "*lead"]
    advantage: Float[Array, "*lead"]
    value_target: Float[Array, "*lead"]


def layers(actor: MLP) -> Layers:
    return tuple((layer.weight, layer.bias) for layer in actor.layers)


def out_of_bounds(position: Float[Array, "*lead 2"]) -> Float[Array, "*lead"]:
    """The penalty of `simple_tag`: 0 up to |x| = 0.9, 10 (|x| - 0.9) up to 1, then exp(2 |x| - 2), at most 10."""
    x = jnp.abs(position)
    return jnp.sum(jnp.where(x < 0.9, 0, jnp.where(x < 1, 10 * (x - 0.9), jnp.minimum(jnp.exp(2 * x - 2), 10))), -1)


def act_all(size: Size, state: State, preys: Int[Array, " preys"]) -> State:
    """A step in which the predators are greedy."""
    action = jnp.concatenate([chase(size, state), preys])
    return move(make_world(size), state, push(make_world(size), action))


def advantages(
    reward: Float[Array, "steps preys"], value: Float[Array, "steps preys"], last: Float[Array, " preys"]
) -> Float[Array, "steps preys"]:
    """Generalised advantage estimation (Schulman et al., 2016). The time limit is not a termination: `last` is V there."""
    following = jnp.concatenate([value[1:], last[None]])
    delta = reward + DISCOUNT * following - value

    def back(sum_: Float[Array, " preys"], now: Float[Array, " preys"]):
        sum_ = now + DISCOUNT * TRACE * sum_
        return sum_, sum_

    return jax.lax.scan(back, jnp.zeros_like(last), delta, reverse=True)[1]


def episode(size: Size, networks: Networks, key: PRNGKeyArray) -> tuple[Samples, Float[Array, ""]]:
    """One episode of preys against greedy predators, and the predators' total reward."""

    def step(state: State, key: PRNGKeyArray):
        observation = observe_preys(size, state)
        log = jax.nn.log_softmax(networks.actor(observation))
        action = jax.random.categorical(key, log)
        state = act_all(size, state, action)
        reward = reward_preys(size, state) - out_of_bounds(state.position[size.preys.start : size.preys.stop])
        chosen = jnp.take_along_axis(log, action[:, None], axis=1)[:, 0]
        return state, (observation, action, chosen, REWARD_SCALE * reward, jnp.sum(reward_predators(size, state)))

    start_key, key = jax.random.split(key)
    state, (observation, action, log, reward, earned) = jax.lax.scan(
        step, reset(size, start_key), jax.random.split(key, MAX_STEPS)
    )
    value = networks.critic(observation)[..., 0]
    advantage = advantages(reward, value, networks.critic(observe_preys(size, state))[..., 0])
    return Samples(observation, action, log, advantage, advantage + value), jnp.sum(earned)


def loss(networks: Networks, batch: Samples) -> Float[Array, ""]:
    """PPO's clipped objective, with entropy bonus and squared value error (Schulman et al., 2017)."""
    log_probabilities = jax.nn.log_softmax(networks.actor(batch.observation))
    log = jnp.take_along_axis(log_probabilities, batch.action[:, None], axis=1)[:, 0]
    ratio = jnp.exp(log - batch.log_probability)
    advantage = (batch.advantage - jnp.mean(batch.advantage)) / (jnp.std(batch.advantage) + 1e-8)
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage)
    entropy = -jnp.sum(jnp.exp(log_probabilities) * log_probabilities, axis=1)
    error = (networks.critic(batch.observation)[:, 0] - batch.value_target) ** 2
    return jnp.mean(-gain - ENTROPY * entropy + 0.5 * error)


@eqx.filter_jit
def iterate(
    networks: Networks, optimizer: optax.OptState, key: PRNGKeyArray
) -> tuple[Networks, optax.OptState, Float[Array, ""]]:
    """Collect WORLDS episodes and make PASSES passes over their steps; also returns the predators' mean reward in them."""
    collect_key, order_key = jax.random.split(key)
    run = partial(episode, SIZES["PP-6"], networks)
    samples, earned = jax.vmap(run)(jax.random.split(collect_key, WORLDS))
    samples = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[3:]), samples)
    orders = jax.vmap(lambda key: jax.random.permutation(key, len(samples.action)))(jax.random.split(order_key, PASSES))

    def learn(carry: tuple[Networks, optax.OptState], rows: Int[Array, " batch"]):
        networks, optimizer = carry
        gradient = jax.grad(loss)(networks, jax.tree.map(lambda leaf: leaf[rows], samples))
        return adam_step(networks, gradient, optimizer, RATE), None

    (networks, optimizer), _ = jax.lax.scan(learn, (networks, optimizer), orders.reshape(PASSES * MINIBATCHES, -1))
    return networks, optimizer, jnp.mean(earned)


def train(seed: int = 0, longest: int = 400) -> None:
    """Train until greedy predators earn as much as from the published prey.

    Args:
        seed: the random seed.
        longest: the most iterations.
    """
    key = jax.random.key(seed)
    sees = SIZES["PP-6"].prey_view.observation_size
    actor_key, critic_key, key = jax.random.split(key, 3)
    networks = Networks(MLP(sees, (64, 64), N_ACTIONS, key=actor_key), MLP(sees, (64, 64), 1, key=critic_key))
    optimizer = init_adam(networks, RATE)
    course: list[float] = []
    while len(course) < longest:
        key, now = jax.random.split(key)
        before = networks
        networks, optimizer, earned = iterate(networks, optimizer, now)
        course.append(float(earned))
        latest = np.mean(course[-LATEST:])
        print(f"{len(course):4d} iterations: predators earned {earned:6.1f}, lately {latest:6.1f}")
        if len(course) >= LATEST and latest < TARGET:
            arrays = {}
            for number, (weight, bias) in enumerate(layers(before.actor)):
                arrays |= {f"weight_{number}": np.asarray(weight), f"bias_{number}": np.asarray(bias)}
            np.savez(SHIPPED, **arrays)
            return print(f"written to {SHIPPED}")
    raise SystemExit(f"the target was not reached after {longest} iterations")


Policy = Callable[[Size, State, PRNGKeyArray], Int[Array, " preys"]]


def shipped(size: Size, state: State, key: PRNGKeyArray) -> Int[Array, " preys"]:
    return sample_actions(shipped_prey(), observe_preys(size, state), key)


def at_random(size: Size, state: State, key: PRNGKeyArray) -> Int[Array, " preys"]:
    return jax.random.randint(key, (size.n_preys,), 0, N_ACTIONS)


@partial(jax.jit, static_argnums=(0, 1, 3))
def earnings(size: Size, policy: Policy, key: PRNGKeyArray, episodes: int) -> Float[Array, " episodes"]:
    """The reward of greedy predators in each of some episodes, summed over predators and steps."""

    def step(state: State, key: PRNGKeyArray):
        state = act_all(size, state, policy(size, state, key))
        return state, jnp.sum(reward_predators(size, state))

    def run(key: PRNGKeyArray) -> Float[Array, ""]:
        start_key, key = jax.random.split(key)
        return jnp.sum(jax.lax.scan(step, reset(size, start_key), jax.random.split(key, MAX_STEPS))[1])

    return jax.vmap(run)(jax.random.split(key, episodes))


def measure(seed: int = 1, episodes: int = 2000) -> None:
    """Let greedy predators chase the shipped prey, and preys that move at random, in all three sizes.

    Args:
        seed: the random seed.
        episodes: number of episodes for each mean.
    """
    table: dict[str, dict[str, Any]] = {}
    for name, size in SIZES.items():
        for policy in (shipped, at_random):
            earned = np.asarray(earnings(size, policy, jax.random.key(seed), episodes), np.float64)
            row = {"mean": earned.mean(), "standard error": earned.std(ddof=1) / episodes**0.5}
            table.setdefault(name, {})[policy.__name__.replace("_", " ")] = row
            print(f"{name:6s} {policy.__name__:10s} {row['mean']:7.2f} ± {row['standard error']:.2f}")
    write("prey", {"seed": seed, "episodes": episodes, "earnings of greedy predators": table})


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"train": train, "measure": measure}, description=__doc__)

"""PPO in one compiled program, in the style of PureJaxRL, on an environment that pays its return at the end of an episode.

    pip install '.[gymnax]'
    python examples/purejax_ppo.py

It trains several seeds on gymnax's CartPole-v1 at once, without a language model. Without the lines that end in "# LaRe", PPO trains
on the return at the end.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import gymnax
import jax
import jax.numpy as jnp
import optax
import tyro

import lare_rl  # LaRe

N_ENVS, N_STEPS, N_EPOCHS, N_MINIBATCHES = 16, 128, 4, 4
GAMMA, LAMBDA, CLIP, ENTROPY = 0.99, 0.95, 0.2, 0.01
MAX_STEPS = 500


class Transition(NamedTuple):
    """Steps of all environments: [N_STEPS N_ENVS ...]."""

    obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    next_obs: jax.Array
    terminated: jax.Array
    truncated: jax.Array


def init_network(key: jax.Array, sizes: tuple[int, ...]) -> list[tuple[jax.Array, jax.Array]]:
    keys = jax.random.split(key, len(sizes) - 1)
    init = jax.nn.initializers.lecun_normal()
    return [(init(k, shape), jnp.zeros(shape[1])) for k, shape in zip(keys, pairwise(sizes), strict=True)]


def apply_network(layers: list[tuple[jax.Array, jax.Array]], x: jax.Array) -> jax.Array:
    for weight, bias in layers[:-1]:
        x = jnp.tanh(x @ weight + bias)
    weight, bias = layers[-1]
    return x @ weight + bias


def make_train(n_updates: int) -> Any:
    """Return the training of one seed: from a key to the mean return of the finished episodes at each update."""
    env, env_params = gymnax.make("CartPole-v1")
    n_obs, n_actions = env.observation_space(env_params).shape[0], env.action_space(env_params).n
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1e-3))
    sizes: Any = {"observation_size": n_obs, "action_size": n_actions, "discrete": True, "max_steps": MAX_STEPS}  # LaRe
    credit = lare_rl.pure_credit("bayes", n_envs=N_ENVS, n_steps=N_STEPS, capacity=100_000, **sizes)  # LaRe

    def policy(params: Any, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.nn.log_softmax(apply_network(params["actor"], obs)), apply_network(params["critic"], obs)[..., 0]

    def loss(params: Any, batch: Transition, advantage: jax.Array, target: jax.Array) -> jax.Array:
        log_probs, value = policy(params, batch.obs)
        log_prob = jnp.take_along_axis(log_probs, batch.action[:, None], axis=1)[:, 0]
        ratio = jnp.exp(log_prob - batch.log_prob)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        actor_loss = -jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage).mean()
        entropy = -(jnp.exp(log_probs) * log_probs).sum(axis=-1).mean()
        return actor_loss + 0.5 * jnp.square(value - target).mean() - ENTROPY * entropy

    def env_step(carry: Any, key: jax.Array, params: Any) -> tuple[Any, Transition]:
        """Step inside the package's auto-reset: the last observation of an episode is its own."""
        env_state, obs, return_ = carry
        action_key, step_key, reset_key = jax.random.split(key, 3)
        log_probs, value = policy(params, obs)
        action = jax.random.categorical(action_key, log_probs)
        step_keys, reset_keys = jax.random.split(step_key, N_ENVS), jax.random.split(reset_key, N_ENVS)
        step = jax.vmap(env.step_env, (0, 0, 0, None))
        next_obs, next_state, reward, terminated, _ = step(step_keys, env_state, action, env_params)
        truncated = jax.vmap(env.is_truncated, (0, None))(next_state, env_params) & ~terminated
        done, return_ = terminated | truncated, return_ + reward
        log_prob = jnp.take_along_axis(log_probs, action[:, None], axis=1)[:, 0]
        episodic_reward = jnp.where(done, return_, 0)  # the episodic setting: the return at the end, and nothing before
        transition = Transition(obs, action, log_prob, value, episodic_reward, next_obs, terminated, truncated)
        first_obs, first_state = jax.vmap(env.reset_env, (0, None))(reset_keys, env_params)

        def restart(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        carry = jax.tree.map(restart, (first_state, first_obs), (next_state, next_obs))
        return (*carry, jnp.where(done, 0, return_)), transition

    def update(carry: dict[str, Any], key: jax.Array) -> tuple[dict[str, Any], jax.Array]:
        params = carry["params"]
        rollout_key, *epoch_keys = jax.random.split(key, 1 + N_EPOCHS)
        rollout_keys = jax.random.split(rollout_key, N_STEPS)
        env_carry, steps = jax.lax.scan(lambda c, k: env_step(c, k, params), carry["env"], rollout_keys)
        done = steps.terminated | steps.truncated
        mean_return = jnp.sum(steps.reward) / jnp.maximum(jnp.sum(done), 1)
        one_hot = jax.nn.one_hot(steps.action, n_actions)  # LaRe
        data = steps.obs, one_hot, steps.next_obs, steps.reward, steps.terminated, steps.truncated  # LaRe
        credit_state = credit.observe(carry["credit"], lare_rl.CreditSteps(*data))  # LaRe
        credit_state = credit.refit(credit_state, jax.random.fold_in(key, 1))  # LaRe
        steps = steps._replace(reward=credit.reward(credit_state, lare_rl.CreditSteps(*data)))  # LaRe
        _, next_value = policy(params, steps.next_obs)
        delta = steps.reward + GAMMA * jnp.where(steps.terminated, 0, next_value) - steps.value
        decay = GAMMA * LAMBDA * ~done

        def backward(advantage: jax.Array, t: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            advantage = t[0] + t[1] * advantage
            return advantage, advantage

        _, advantage = jax.lax.scan(backward, jnp.zeros(N_ENVS), (delta, decay), reverse=True)
        rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (steps, advantage, advantage + steps.value))

        def minibatch(carry: Any, index: jax.Array) -> tuple[Any, None]:
            params, opt_state = carry
            gradient = jax.grad(loss)(params, *jax.tree.map(lambda x: x[index], rows))
            changes, opt_state = optimizer.update(gradient, opt_state)
            return (optax.apply_updates(params, changes), opt_state), None

        order = jnp.concatenate([jax.random.permutation(k, N_STEPS * N_ENVS) for k in epoch_keys])
        indices = order.reshape(N_EPOCHS * N_MINIBATCHES, -1)
        (params, opt_state), _ = jax.lax.scan(minibatch, (params, carry["optimizer"]), indices)
        carry = carry | {"params": params, "optimizer": opt_state, "env": env_carry}
        carry["credit"] = credit_state  # LaRe
        return carry, mean_return

    def train(key: jax.Array) -> jax.Array:
        actor_key, critic_key, env_key, key = jax.random.split(key, 4)
        params = {
            "actor": init_network(actor_key, (n_obs, 64, 64, n_actions)),
            "critic": init_network(critic_key, (n_obs, 64, 64, 1)),
        }
        obs, env_state = jax.vmap(env.reset_env, (0, None))(jax.random.split(env_key, N_ENVS), env_params)
        carry = {"params": params, "optimizer": optimizer.init(params), "env": (env_state, obs, jnp.zeros(N_ENVS))}
        carry["credit"] = credit.init(jax.random.fold_in(key, 1))  # LaRe
        return jax.lax.scan(update, carry, jax.random.split(key, n_updates))[1]

    return train


def main(updates: int = 100, seeds: int = 4) -> jax.Array:
    """Train. Return the mean return of each seed at each update.

    Args:
        updates: iterations of 2,048 steps.
        seeds: the number of seeds, trained at once by vmap.
    """
    returns = jax.jit(jax.vmap(make_train(updates)))(jax.random.split(jax.random.key(0), seeds))
    for i in range(9, updates, 10):
        print(f"{(i + 1) * N_STEPS * N_ENVS:8,} steps: return {returns[:, i - 9 : i + 1].mean():.1f}")
    return returns


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)

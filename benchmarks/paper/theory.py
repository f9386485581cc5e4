"""Section "Analysis" and appendix B of the LaRe paper, as code for small tabular problems.

An episode of T steps reveals only the sum of its rewards. The regularised least-squares estimator learns the reward of every
entry of a table from such sums; the smaller the table, the fewer episodes it needs. The raw table has an entry for each state
and action, |S||A| of them. The latent table has an entry for each value of the latent reward, |D| of them: states that differ only
in irrelevant parts share an entry. Propositions 1 and 2 bound the error and the regret of both.

States are pairs (core, redundant). The action moves the core, and the core decides the reward. The redundant part is random at
every step and decides nothing; phi leaves it out. Policies depend on the core only, so that the maximum over all of them is exact
in both tables.
"""

import itertools
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray


class MDP(NamedTuple):
    """A problem with finitely many states and a horizon."""

    transition: Float[Array, "cores actions cores"]
    """P(c' | c, a)."""
    reward: Float[Array, "cores actions"]
    """r in [0, 1]: the probability that a step pays 1."""


class Table(NamedTuple):
    """The sizes of the estimator's table; `redundant` = 1 is the latent table."""

    cores: int
    redundant: int
    actions: int

    @property
    def size(self) -> int:
        """|S||A|, or |D|."""
        return self.cores * self.redundant * self.actions


class Estimator(NamedTuple):
    """Regularised least squares on episode sums."""

    design: Float[Array, "size size"]
    """A_k = H_k^T H_k + lambda I."""
    products: Float[Array, " size"]
    """Y_k = sum_l h_l R_l."""


class History(NamedTuple):
    """Results, episode by episode."""

    regret: Float[Array, " episodes"]
    """rho(k), the sum of V* - V^pi up to episode k."""
    error: Float[Array, " episodes"]
    """|r - r_hat_k|_{A_k}."""
    radius: Float[Array, " episodes"]
    """l_k."""


def random_mdp(key: PRNGKeyArray, cores: int, actions: int) -> MDP:
    """Transitions from Dirichlet(1), rewards uniform in [0, 1]."""
    transition_key, reward_key = jax.random.split(key)
    transition = jax.random.dirichlet(transition_key, jnp.ones(cores), (cores, actions))
    return MDP(transition, jax.random.uniform(reward_key, (cores, actions)))


def policies(cores: int, actions: int) -> Int[Array, "policies cores"]:
    """Every deterministic policy that depends on the core only."""
    return jnp.asarray(np.array(list(itertools.product(range(actions), repeat=cores))))


def visits(mdp: MDP, policy: Int[Array, " cores"], horizon: int) -> Float[Array, "cores actions"]:
    """h_pi: the expected number of visits to each core and action in an episode, which begins in core 0."""
    cores, actions = mdp.reward.shape
    moves = mdp.transition[jnp.arange(cores), policy]

    def step(chance: Float[Array, " cores"], _: None):
        return chance @ moves, chance

    _, chances = jax.lax.scan(step, jnp.eye(cores)[0], length=horizon)
    return jnp.sum(chances, axis=0)[:, None] * jax.nn.one_hot(policy, actions)


def shared_out(core_values: Float[Array, "*batch cores actions"], table: Table) -> Float[Array, "*batch size"]:
    """A table of the core's entries, each shared out evenly over the redundant ones."""
    share = jnp.repeat(core_values[..., :, None, :] / table.redundant, table.redundant, axis=-2)
    return share.reshape(*core_values.shape[:-2], table.size)


def nothing_seen(size: int, ridge: float) -> Estimator:
    return Estimator(ridge * jnp.eye(size), jnp.zeros(size))


def update(state: Estimator, counts: Float[Array, " size"], total: Float[Array, ""]) -> Estimator:
    """Add an episode: how often it visited each entry, and its return."""
    return Estimator(state.design + jnp.outer(counts, counts), state.products + counts * total)


def estimate(state: Estimator) -> Float[Array, " size"]:
    """r_hat_k = A_k^-1 Y_k."""
    return jnp.linalg.solve(state.design, state.products)


def radius(
    episodes: Float[Array, "*batch"], horizon: int, size: int, ridge: float, delta: float
) -> Float[Array, "*batch"]:
    """l_k of Proposition 1: sqrt(T D / 4 * log((1 + k T^2 / lambda) / (delta / 10))) + sqrt(lambda D)."""
    grown = jnp.log((1 + episodes * horizon**2 / ridge) / (delta / 10))
    return jnp.sqrt(horizon * size * grown / 4) + jnp.sqrt(ridge * size)


def optimistic(state: Estimator, expected: Float[Array, "policies size"], width: Float[Array, ""]) -> Int[Array, ""]:
    """OFUL's choice: argmax_pi h_pi^T r_hat + l |h_pi|_{A^-1}."""
    uncertain = jnp.sum(expected.T * jnp.linalg.solve(state.design, expected.T), axis=0)
    return jnp.argmax(expected @ estimate(state) + width * jnp.sqrt(jnp.maximum(uncertain, 0)))


def play(
    key: PRNGKeyArray, mdp: MDP, policy: Int[Array, " cores"], table: Table, horizon: int
) -> tuple[Float[Array, " size"], Float[Array, ""]]:
    """Play an episode: how often it visited each entry of the table, and the sum of its rewards."""

    def step(core: Int[Array, ""], key: PRNGKeyArray):
        move_key, redundant_key, reward_key = jax.random.split(key, 3)
        action = policy[core]
        redundant = jax.random.randint(redundant_key, (), 0, table.redundant)
        entry = (core * table.redundant + redundant) * table.actions + action
        reward = jax.random.bernoulli(reward_key, mdp.reward[core, action]).astype(jnp.float32)
        return jax.random.categorical(move_key, jnp.log(mdp.transition[core, action])), (entry, reward)

    _, (entries, reward) = jax.lax.scan(step, jnp.zeros((), jnp.int32), jax.random.split(key, horizon))
    return jnp.zeros(table.size).at[entries].add(1.0), jnp.sum(reward)


@partial(jax.jit, static_argnames=("redundant", "horizon", "episodes", "delta"))
def oful(key: PRNGKeyArray, mdp: MDP, redundant: int, horizon: int, episodes: int, delta: float = 0.1) -> History:
    """OFUL for per-trajectory feedback (Efroni et al., 2021; appendix B), with lambda = T.

    It learns a table with `redundant` entries for each core and action. With phi, this number is always 1.
    """
    cores, actions = mdp.reward.shape
    table, ridge = Table(cores, redundant, actions), float(horizon)
    choices = policies(cores, actions)
    core_values = jax.vmap(lambda policy: visits(mdp, policy, horizon))(choices)
    expected = shared_out(core_values, table)
    value = jnp.sum(core_values * mdp.reward, axis=(1, 2))
    true = shared_out(mdp.reward * redundant, table)

    def step_episode(carry: tuple[Estimator, Float[Array, ""]], turn: tuple[PRNGKeyArray, Float[Array, ""]]):
        (state, regret), (key, number) = carry, turn
        chosen = optimistic(state, expected, radius(number, horizon, table.size, ridge, delta))
        state = update(state, *play(key, mdp, choices[chosen], table, horizon))
        regret = regret + jnp.max(value) - value[chosen]
        away = true - estimate(state)
        error = jnp.sqrt(away @ state.design @ away)
        return (state, regret), History(regret, error, radius(number + 1, horizon, table.size, ridge, delta))

    turns = (jax.random.split(key, episodes), jnp.arange(episodes, dtype=jnp.float32))
    return jax.lax.scan(step_episode, (nothing_seen(table.size, ridge), jnp.zeros(())), turns)[1]


def bound_holds(history: History) -> Bool[Array, "*runs"]:
    """Whether |r - r_hat_k|_{A_k} <= l_k at every k, as Proposition 1 promises with probability 1 - delta / 10."""
    return jnp.all(history.error <= history.radius, axis=-1)

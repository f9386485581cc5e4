"""Reflection during a run: phi is judged by the stored episodes, and a phi that explains their returns better replaces it.

The factors of all stored steps are then computed again from the stored observations, and the decoder is fitted in closed form to
all stored episodes, so that it matches the new phi at once. The state of the algorithm is unchanged.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from lare_rl.data.replay import Replay, StoredSteps, oldest_transition, read
from lare_rl.data.sampling import episodes_since, in_order
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import Team, Timestep, env_action, team_mean
from lare_rl.envs.play import Episode, rows_of
from lare_rl.latent.function import LatentFunction
from lare_rl.latent.improve import Model, improve
from lare_rl.runs.directory import Run
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.episodes import Credit, fit_those_due, from_stored
from lare_rl.training.factors import host_factors
from lare_rl.training.learner import Learner, init_credit
from lare_rl.training.reflect import evidence_of
from lare_rl.training.seed_axis import of_seed
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import seed_keys
from lare_rl.util.float64 import float64

EPISODES = 200
"""Functions are judged by so many newest episodes of all seeds together."""
ROWS = 10_000
"""Steps whose factors are computed at a time."""


def reflected(
    run: Run, config: TrainConfig, learner: Learner, model: Model, said: Callable[[str], None]
) -> tuple[LatentFunction, ...]:
    """The functions of a run after one round of reflection for each, on the run's stored episodes."""
    found = []
    for place, (function, role) in enumerate(zip(run.functions, run.config.task.roles, strict=True)):
        known = None if config.credit.score == "auto" else config.credit.score
        role = role.model_copy(update={"judges": run.judges, "score": known})
        episodes = stored_episodes(learner, config, role, place)

        def judge(one: LatentFunction, role: TaskSpec = role, episodes: list[Episode] = episodes):
            return evidence_of(one, role, episodes)

        team = f"{role.team}: " if len(run.functions) > 1 else ""
        found.append(improve(function, role, model, judge, said=lambda line, team=team: said(team + line)))
    return tuple(found)


def stored_episodes(learner: Learner, config: TrainConfig, role: TaskSpec, place: int) -> list[Episode]:
    """The newest finished episodes of all seeds, as one role is judged, in the order in which they were played."""
    seeds = len(learner.counted)
    each = max(1, EPISODES // (seeds * config.environments))
    read_one, found = jax.jit(partial(stored_episode, longest=config.env.max_steps)), []
    for seed in range(seeds):
        buffer = of_seed(learner.replay, seed)
        since = jnp.maximum(buffer.episodes - each, buffer.oldest)
        ends = np.cumsum(np.asarray(episodes_since(buffer, since)))
        for env, end in enumerate(ends):
            start = ends[env - 1] if env else 0
            for number in range(start, end):
                steps, length = read_one(buffer, since, number)
                # The newest of each environment were played at about the same time.
                found.append((number - end, as_judged(steps, int(length), config, role, config.env.teams[place])))
    return [episode for _, episode in sorted(found, key=lambda one: one[0])]


def stored_episode(
    buffer: Replay, since: Int[Array, " envs"], number: Int[Array, ""], longest: int
) -> tuple[StoredSteps, Int[Array, ""]]:
    """The steps of one finished episode, followed by padding, and the number of steps."""
    sample = in_order(buffer, since, number, 1, longest)
    return read(buffer, sample.steps), sample.episodes.length[0]


def as_judged(steps: StoredSteps, length: int, config: TrainConfig, role: TaskSpec, team: Team) -> Episode:
    """Stored steps as an episode, as a role is judged."""
    env = config.env
    before, after = (
        {name: np.asarray(part)[:length] for name, part in one.items()} for one in (steps.before, steps.after)
    )
    shown, led_to = timestep(before), timestep(after)
    taken = env_action(before["action"], env)
    alive = before.get("alive", np.ones((length, env.agents), bool))
    paid = np.asarray(team_mean(before["reward"], alive, team))
    rows, action = rows_of(role.judged_from, team, shown, taken)
    there, reward = alive[:, team.agents], before["reward"][:, team.agents]
    if config.of_state:
        there, reward = np.ones((length, 1), bool), paid[:, None]
    return Episode(rows, action, rows_of(role.judged_from, team, led_to, taken)[0], there, reward, paid)


def timestep(columns: dict[str, np.ndarray]) -> Timestep:
    """A time step with the arrays that latent functions read; the others are empty."""
    none = np.zeros(0, np.float32)
    return Timestep(
        observation=columns.get("observation", none),
        state=columns.get("state", none),
        available=none,
        alive=none,
        reward=none,
        terminated=none,
        truncated=none,
        measures={},
    )


def with_functions(run: Run, config: TrainConfig, learner: Learner) -> Learner:
    """The learner with the factors and the decoders of a run's new functions.

    Args:
        run: the run with the new functions.
        config: the configuration of that run.
        learner: the learner with the factors of the old functions.
    """
    columns = dict(learner.replay.columns)
    buffers = [of_seed(learner.replay, seed) for seed in range(len(run.seeds))]
    columns["factors"] = jnp.stack([factors_again(run, config, buffer) for buffer in buffers])
    buffer = learner.replay._replace(columns=columns)
    credit = jax.vmap(partial(untrained, config=config))(learner.credit, seed_keys(jnp.asarray(run.seeds), 0))
    with float64():
        credit = jax.block_until_ready(jax.jit(partial(fitted_to_all, config=config))(credit, buffer))
    return learner._replace(credit=credit, replay=buffer, counted=jnp.copy(buffer.episodes))


def factors_again(run: Run, config: TrainConfig, buffer: Replay) -> Float[Array, "envs rows judged factors"]:
    """The factors of all steps that are stored, in their rows."""
    envs, capacity = buffer.row.shape
    found = np.zeros((envs, capacity, config.judged_rows, max(config.factors)), np.float32)
    first, last = np.asarray(oldest_transition(buffer)), np.asarray(buffer.transitions)
    columns = {name: np.asarray(column) for name, column in buffer.columns.items()}
    for env in range(envs):
        rows = np.asarray(buffer.row)[env, np.arange(first[env], last[env]) % capacity]
        for some in np.split(rows, range(ROWS, len(rows), ROWS)):
            shown, led_to = (
                timestep({name: column[env, at] for name, column in columns.items()})
                for at in (some, (some + 1) % capacity)
            )
            action = columns["action"][env, some]
            steps = Trajectory(shown, action, env_action(action, config.env), led_to)
            found[env, some] = host_factors(run, config, steps)
    return jnp.asarray(found)


def untrained(known: Credit, key: Array, config: TrainConfig) -> Credit:
    """New decoders of one seed. The parts that depend on returns alone are kept."""
    return tuple(
        new._replace(scale=old.scale, return_scale=old.return_scale, average=old.average, rivals=old.rivals)
        for new, old in zip(init_credit([key] * len(known), config), known, strict=True)
    )


def fitted_to_all(credit: Credit, buffer: Replay, config: TrainConfig) -> Credit:
    """Fit untrained decoders of all seeds to all stored episodes; in float64, if that is enabled."""
    credit = jax.vmap(lambda one, stored: from_stored(one, stored, config))(credit, buffer)
    every = jnp.ones(len(buffer.episodes), bool)
    return tuple(fit_those_due(one, every, config) for one in credit)


def in_place_of(run: Run, functions: tuple[LatentFunction, ...], step: int) -> Run:
    """The run with new functions from a step on, which are saved in its directory."""
    renewed = replace(run, functions=functions, since=step)
    renewed.keep_functions()
    return renewed

"""New episodes of a run's policy, with each agent's credit, for films, credit maps and statistics."""

import contextlib
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from lare_rl.data import replay
from lare_rl.data.replay import Index
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.families import make_env, make_host_env
from lare_rl.envs.interface import HostEnv, JaxEnv
from lare_rl.envs.workers import LocalEnvs
from lare_rl.runs.directory import Run
from lare_rl.training import learner as learning
from lare_rl.training.collect_device import play
from lare_rl.training.collect_host import HostEpisodes
from lare_rl.training.compiled import compiled, module_of, new_memory
from lare_rl.training.factors import host_factors
from lare_rl.training.learner import Learner, Paid
from lare_rl.training.seed_axis import of_seed
from lare_rl.training.session import load_learner
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import device_noise


@dataclass(frozen=True)
class Watched:
    """Whole episodes of the first seed's policy."""

    config: TrainConfig
    steps: Trajectory
    """[time episodes ...]."""
    mask: Bool[np.ndarray, "time episodes"]
    """Whether the episode had not ended before the step."""
    factors: Float[np.ndarray, "time episodes rows factors"]
    proxy: Float[np.ndarray, "time episodes agents"] | None
    """Proxy rewards, by the decoders of the last checkpoint; None for a method without any."""
    state: Any
    """The states after each step, if the environment is made of pure functions."""

    @property
    def reward(self) -> Float[np.ndarray, "time episodes agents"]:
        """True rewards."""
        return np.asarray(self.steps.after.reward)

    @property
    def credit(self) -> Float[np.ndarray, "time episodes agents"]:
        """Proxy rewards; for a method without any, the true rewards."""
        return self.reward if self.proxy is None else self.proxy

    def of_episode(self, values: np.ndarray, place: int = 0) -> np.ndarray:
        """The values of one episode, [time ...]."""
        return values[: int(self.mask[:, place].sum()), place]


def watch(run: Run, episodes: int = 1, random: bool = False, key: int = 0) -> Watched:
    """Play episodes as in training, or with random actions."""
    config, learner, _, _ = load_learner(run)
    one = jax.tree.map(lambda leaf: leaf[:1], learner)
    actor = module_of(config).actor(one, run.config.settings.steps, config)
    if random:
        actor = jax.tree.map(jnp.zeros_like, actor)  # networks of zeros have no preference
    env = make_env(run.config.task)
    if isinstance(env, HostEnv):
        env.close()
        steps, mask, state = *on_host(run, config, actor, episodes), None
    else:
        steps, mask, state = on_device(env, config, actor, episodes, key)
    factors = host_factors(run, config, steps)
    proxy = proxy_of(of_seed(learner), steps, factors, config) if config.method.has_proxy else None
    return Watched(config, steps, mask, factors, proxy, state)


def on_device(env: JaxEnv, config: TrainConfig, actor: Any, episodes: int, key: int) -> tuple[Any, Any, Any]:
    """Whole episodes, in one compiled call."""
    keys = jax.random.key(key)[None]
    played = jax.jit(partial(play, env, count=episodes, config=config, greedy=False))(actor, keys)
    steps, mask, state = jax.tree.map(lambda leaf: np.asarray(leaf)[:, 0], tuple(played))
    return steps, mask, state


def on_host(run: Run, config: TrainConfig, actor: Any, episodes: int) -> tuple[Trajectory, np.ndarray]:
    """Steps until every environment has finished an episode; steps after the end of an episode are masked."""
    functions, env = compiled(config), config.env
    memory = [new_memory(config, 1, episodes)]
    steps, random = [], jax.random.key(0)
    with contextlib.closing(LocalEnvs([partial(make_host_env, run.config.task)] * episodes)) as envs:
        collector = HostEpisodes(envs, run.seeds[:1], episodes)
        collector.begin()
        ended = np.zeros((1, episodes), bool)
        while not ended.all():
            random, now = jax.random.split(random)
            shape = 1, episodes, env.agents, config.noise_size
            shown = collector.shown
            given = (
                actor,
                memory[0],
                shown.observation,
                shown.available,
                device_noise(now, config.noise, shape),
                collector.new,
            )
            action, memory[0] = functions.explore(*given)
            one = collector.collect(lambda *_, action=action: np.asarray(action), np.zeros(1))
            steps.append(jax.tree.map(lambda leaf: leaf[:, 0], one))
            ended |= steps[-1].ended
    played = jax.tree.map(lambda *rows: np.concatenate(rows), *steps)
    before = np.cumsum(played.ended, axis=0) - played.ended
    return played, before == 0


def proxy_of(
    learner: Learner, steps: Trajectory, factors: np.ndarray, config: TrainConfig
) -> Float[np.ndarray, "time episodes agents"]:
    """The proxy rewards of episodes by a single seed's decoders. A new replay holds these episodes alone."""
    time, episodes = np.shape(steps.after.terminated)
    buffer = replay.empty(config.columns, episodes, 2 * time + 2, len(config.env.teams))

    @jax.jit
    def decoded(steps: Trajectory, factors: Any) -> Any:
        rows = learning.rows_of(steps, factors, config)
        whole = replay.extend(buffer, *rows, learning.team_rewards(steps, config), steps.ended)
        drawn = replay.read(whole, replay.newest(whole, time))
        return jnp.swapaxes(learning.rewards(drawn, Paid(learner.credit, learner.scale), config), 0, 1)

    return np.asarray(decoded(jax.tree.map(jnp.asarray, steps), jnp.asarray(factors)))


def newest_episode(learner: Learner) -> Index | None:
    """The steps of the last finished episode of a seed's first environment; None if there is none yet."""
    buffer = learner.replay
    if not int(replay.finished(buffer)[0]):
        return None
    env, episode = np.int32(0), np.asarray(buffer.episodes)[0] - 1
    begin = int(np.asarray(buffer.first)[0, episode % buffer.first.shape[-1]])
    number = np.arange(begin, int(jax.jit(replay.end_of)(buffer, env, episode)))
    return Index(jnp.zeros(len(number), int), jnp.asarray(number))

"""Collects from environments that step on the host: each step calls the policy once, for all environments of all seeds.

The policy acts on the CPU. Once for each iteration, its weights are copied there, noise is drawn, and actions are checked.

An episode is determined by its seed and its actions. To resume a run in the middle of an episode, in any simulator, its environment is
reset with the seed, and the actions are repeated. The observation must then be the same, bit for bit.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.config.train_config import TrainConfig
from lare_rl.data.trajectory import Trajectory, empty_trajectory
from lare_rl.envs.env_errors import EnvOutputError
from lare_rl.envs.interface import Timestep, to_env_action
from lare_rl.envs.placement import make_vec_env, n_open_envs
from lare_rl.envs.vec_env import VecEnv
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.divergence import check_actions
from lare_rl.training.evaluation import Evaluation
from lare_rl.training.policy import draw_noise, init_host_memory, make_host_policy
from lare_rl.training.streams import Stream, episode_seed, numpy_generator
from lare_rl.training.unroll_host import add_seed_axis, evaluate_policy_on_host

__all__ = ["HostCollector", "make_host_collector"]


class HostCollector:
    """The training environments of a run, with the running episode of each, and its evaluation environments.

    Args:
        envs: `n_envs` environments of the first seed, then of the second, and so on.
        evaluation_envs: environments for evaluations in the same order, equally many for each seed.
        seeds: the seeds of the run.
    """

    def __init__(self, envs: VecEnv, evaluation_envs: VecEnv, config: TrainConfig, seeds: Sequence[int]):
        self.shape = len(seeds), config.n_envs
        self._config, self._seeds, self._n_envs = config, list(seeds), config.n_envs
        self._envs, self._evaluation_envs = envs, evaluation_envs
        self._action_shape = envs.spec.n_agents, envs.spec.action_size
        self._memory = init_host_memory(config, *self.shape)
        """The memory of the actors."""
        self._step = 0
        self._on_step: Callable[[int], None] = lambda step: None
        self._episode = np.full(len(seeds) * config.n_envs, -1)
        """The number of each environment's running episode, among the episodes of this environment."""
        self._actions: list[list[np.ndarray]] = [[] for _ in self._episode]
        """The actions of that episode, in the environment's units."""
        self._timestep = add_seed_axis(envs.batch, self.shape)
        """The current time step of each environment. The next step overwrites it."""
        self._episode_start = np.ones(self.shape, bool)
        self._reset(np.ones(len(self._episode), bool))

    def watch(self, on_step: Callable[[int], None], stop_requested: Callable[[], bool]) -> None:
        """Call `on_step` with the number of steps of each seed whenever environments have stepped, also in evaluations.

        `stop_requested` returns whether the user wants to stop. Environments in other processes must then reply soon.
        """
        self._on_step = on_step
        self._envs.stop_requested = self._evaluation_envs.stop_requested = stop_requested

    def collect(self, actor: Any, step: int) -> Trajectory:
        """Return the steps of the iteration that begins at `step`. During the warmup, actions are random."""
        config, rngs = self._config, [numpy_generator(seed, Stream.EXPLORATION, step) for seed in self._seeds]
        self._step = step
        if step < config.warmup:
            shape = config.rollout_steps, config.n_envs, *self._action_shape
            action = np.stack([rng.uniform(-1, 1, shape) for rng in rngs], axis=1).astype(np.float32)
            return self.collect_by(lambda timestep, action_t, episode_start: action_t, action)
        policy = make_host_policy(config, actor, config.n_envs, deterministic=False)
        noise = np.moveaxis(draw_noise(config, rngs, config.rollout_steps, config.n_envs), 1, 0)

        def explore(timestep: Timestep, noise_t: np.ndarray, episode_start: np.ndarray) -> np.ndarray:
            inputs = timestep.observation, timestep.available, noise_t, episode_start
            action, self._memory = policy(self._memory, *inputs)
            return action

        return self.collect_by(explore, noise)

    def collect_by(
        self, policy: Callable[..., Any], noise: Float[np.ndarray, "time seeds envs agents noise"]
    ) -> Trajectory:
        """Let a policy act for as many steps as there is noise. When an episode ends, the next one begins.

        The policy is a function from a timestep, noise, and which episodes have just begun, to the action.
        """
        steps = empty_trajectory(self._envs.spec, len(self._seeds), len(noise), self._n_envs)
        try:
            for t, noise_t in enumerate(noise):
                self._collect_step(policy, noise_t, steps, t)
                self._step += self._n_envs
                self._on_step(self._step)
        finally:
            check_actions(steps.action, self._seeds)  # NaN as an action may have caused the error
        return steps

    def _collect_step(
        self, policy: Callable[..., Any], noise: Float[np.ndarray, "seeds envs agents noise"], steps: Trajectory, t: int
    ) -> None:
        """Make a step, and write it into row `t` of the steps."""
        action = policy(self._timestep, noise, self._episode_start)
        env_action = to_env_action(action, self._envs.spec)
        _write_timestep(steps.timestep, t, self._timestep)
        steps.action[:, t], steps.env_action[:, t] = action, env_action
        rows = env_action.reshape(-1, *env_action.shape[2:])
        for actions, row in zip(self._actions, rows, strict=True):
            actions.append(row)
        with self._locate_errors():
            self._envs.step(rows)
        _write_timestep(steps.next_timestep, t, self._timestep)
        self._episode_start = np.zeros(self.shape, bool)
        ended = np.logical_or(self._timestep.terminated, self._timestep.truncated)
        if ended.any():
            self._reset(ended.ravel())

    def _reset(self, where: Bool[np.ndarray, " all"]) -> None:
        """Start the next episode in the environments that `where` selects."""
        self._episode[where] += 1
        for index in np.flatnonzero(where):
            self._actions[index] = []
        with self._locate_errors():
            self._envs.reset(where, self._episode_seeds())
        self._episode_start = self._episode_start | where.reshape(self.shape)

    def evaluate(self, actor: Any, n_episodes: int, deterministic: bool = False) -> Evaluation:
        """Evaluate whole episodes of the policy, always from the same initial states. If `deterministic`, it acts without noise."""
        config = replace(self._config, deterministic=True) if deterministic else self._config
        return evaluate_policy_on_host(
            self._evaluation_envs, config, actor, self._seeds, n_episodes, on_step=lambda: self._on_step(self._step)
        )

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the arrays that `restore` needs: numbers and actions of the running episodes, and the actors' memory."""
        arrays = {f"memory{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(self._memory))}
        arrays |= {"episode": self._episode.copy(), "new": self._episode_start}
        for index, actions in enumerate(self._actions):
            arrays[f"actions{index}"] = np.reshape(actions, (-1, *self._action_shape))
            arrays[f"observation{index}"] = self._envs.batch.observation[index].copy()
        return arrays

    def restore(self, arrays: dict[str, np.ndarray]) -> tuple[Bool[np.ndarray, "seeds envs"], list[str]]:
        """Restore the running episodes, by their seeds and actions.

        If the last observation differs in one bit, or an action is not available any more, the environment is not deterministic: the
        episode is dropped, and a new one begins.

        Returns:
            Which episodes were dropped, and a message about each of them.
        """
        leaves, structure = jax.tree.flatten(self._memory)
        self._memory = jax.tree.unflatten(structure, [arrays[f"memory{i}"] for i in range(len(leaves))])
        self._episode = arrays["episode"].copy()
        indices = range(len(self._episode))
        actions = [arrays[f"actions{index}"] for index in indices]
        self._actions = [[] for _ in indices]
        idle = np.zeros(self._action_shape, np.float32)  # of environments that do not step
        with self._locate_errors():
            self._envs.reset(np.ones(len(indices), bool), self._episode_seeds())
        differs = np.zeros(len(indices), bool)
        for t in range(max(map(len, actions))):
            where = np.array([t < len(rows) for rows in actions]) & ~differs
            for index in np.flatnonzero(where):
                self._actions[index].append(actions[index][t])
            action_t = np.stack([rows[-1] if rows else idle for rows in self._actions])
            if self._config.env.masks_actions:  # some environments fail if an action is not available
                differs |= where & ~((action_t > 0) <= self._envs.batch.available).all(axis=(-1, -2))
                where &= ~differs
            with self._locate_errors():
                timestep = self._envs.step(action_t, where)
            differs |= where & (timestep.terminated | timestep.truncated)
        self._episode_start = arrays["new"].copy()
        same = [np.array_equal(self._envs.batch.observation[i], arrays[f"observation{i}"]) for i in indices]
        dropped = differs | ~np.array(same)
        messages = [
            f"{self._episode_name(index)} was dropped after {len(actions[index])} steps: "
            "the same actions did not lead to the same observation again"
            for index in np.flatnonzero(dropped).tolist()
        ]
        if dropped.any():
            self._reset(dropped)
        return dropped.reshape(self.shape), messages

    def close(self) -> None:
        """Close the environments."""
        try:
            self._envs.close()
        finally:
            self._evaluation_envs.close()

    def _seed(self, index: int) -> int:
        return self._seeds[index // self._n_envs]

    def _episode_name(self, index: int) -> str:
        env = f" in environment {index % self._n_envs}" if self._n_envs > 1 else ""
        return f"episode {self._episode[index]} of seed {self._seed(index)}{env}"

    def _episode_seeds(self) -> Int[np.ndarray, " all"]:
        """Return the random seed of each environment's running episode."""
        # The number of an episode among those of all environments of the seed.
        numbers = [int(episode) * self._n_envs + i % self._n_envs for i, episode in enumerate(self._episode)]
        return np.array(
            [episode_seed(self._seed(i), Stream.TRAINING_EPISODES, number) for i, number in enumerate(numbers)]
        )

    @contextlib.contextmanager
    def _locate_errors(self) -> Iterator[None]:
        """Add the step, episode and seed of an environment to an `EnvOutputError` of a block."""
        try:
            yield
        except EnvOutputError as error:
            if (index := error.env_index) is None:
                raise
            where = f"at step {len(self._actions[index])} of {self._episode_name(index)}"
            raise EnvOutputError(f"{error}, {where}") from None


def make_host_collector(
    task: TaskSpec, config: TrainConfig, seeds: Sequence[int], n_evaluation_episodes: int
) -> HostCollector:
    """Make a collector with a task's environments. If a seed has several, they step in worker processes."""
    n_seeds = len(seeds)
    with contextlib.ExitStack() as opened:
        envs = opened.enter_context(make_vec_env(task, n_seeds * config.n_envs, parallel=config.n_envs > 1))
        n_evaluation_envs = n_seeds * n_open_envs(task, n_seeds, n_evaluation_episodes)
        evaluation_envs = opened.enter_context(make_vec_env(task.evaluation_task, n_evaluation_envs))
        collector = HostCollector(envs, evaluation_envs, config, seeds)
        opened.pop_all()  # from here on, the collector closes them
    return collector


def _write_timestep(columns: Timestep, t: int, timestep: Timestep) -> None:
    *arrays, measures = columns
    for column, value in zip(arrays, timestep, strict=False):
        column[:, t] = value
    for name, column in measures.items():
        column[:, t] = timestep.measures[name]

"""Collecting from environments that step on the host: each step calls the policy once, for all environments of all seeds.

An episode is determined by its seed and its actions. So a run can be resumed in the middle of an episode, in any simulator: reset
with the seed, play the actions, and compare the observation bit for bit.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.families import make_host_env
from lare_rl.envs.guarded_gymnasium import EnvironmentFault
from lare_rl.envs.interface import EnvSpec, Timestep, env_action, team_mean
from lare_rl.envs.workers import LocalEnvs, WorkerEnvs
from lare_rl.errors import LareError
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.compiled import Compiled, new_memory
from lare_rl.training.evaluation import Evaluation
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import Stream, episode_seed, generator, host_noise

Envs = LocalEnvs | WorkerEnvs
"""Environments in one list: those of the first seed, of the second, and so on."""

Acting = Callable[[Timestep, Bool[np.ndarray, "seeds envs"]], Float[np.ndarray, "seeds envs agents action"]]
"""From a time step, and which episodes are new, to actions."""


class Diverged(LareError):
    """The policy is not finite any more."""


class HostEpisodes:
    """The training environments of a run, and the running episode of each."""

    def __init__(self, envs: Envs, seeds: Sequence[int], environments: int):
        self.envs, self.seeds, self.environments = envs, list(seeds), environments
        self.spec = envs.spec
        count = len(self.seeds) * environments
        self.episode = np.full(count, -1)
        """The number of each environment's running episode."""
        self.actions: list[list[np.ndarray]] = [[] for _ in range(count)]
        """The actions of that episode, in the environment's units."""
        self.shown = shaped(envs.batch, self.shape)
        """The current time step of each environment. The next step overwrites it."""
        self.new = np.ones(self.shape, bool)
        """Which episodes have not had a step yet."""
        self.dropped = np.zeros(count, bool)
        """Which episodes `restore` could not restore."""

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.seeds), self.environments

    def begin(self, where: Bool[np.ndarray, " all"] | None = None) -> None:
        """Start the next episode in some of the environments, or in all."""
        where = np.ones(len(self.episode), bool) if where is None else where
        self.episode[where] += 1
        for number in np.flatnonzero(where):
            self.actions[number] = []
        self.asked(lambda: self.envs.reset(where, self.episode_seeds()))
        self.new = self.new | where.reshape(self.shape)

    def episode_seeds(self) -> Int[np.ndarray, " all"]:
        """The random seed of each environment's running episode."""
        return np.array(
            [
                episode_seed(self.seed_of(number), Stream.TRAINING_EPISODES, self.number_of(number))
                for number in range(len(self.episode))
            ]
        )

    def seed_of(self, place: int) -> int:
        """The seed that an environment belongs to."""
        return self.seeds[place // self.environments]

    def number_of(self, place: int) -> int:
        """The running episode's number among all episodes of the seed."""
        return int(self.episode[place]) * self.environments + place % self.environments

    def step(self, taken: Float[np.ndarray, "seeds envs agents action"]) -> None:
        """One step of all environments, with actions in their units."""
        rows = taken.reshape(-1, *taken.shape[2:])
        for actions, row in zip(self.actions, rows, strict=True):
            actions.append(row)
        self.asked(lambda: self.envs.step(rows))

    def collect(self, act: Callable[..., Any], noise: Float[np.ndarray, "time seeds envs agents noise"]) -> Trajectory:
        """Let the policy act for as many steps as there is noise."""
        steps = blank_trajectory(self.spec, self.shown, self.shape, len(noise))
        for time, disturbance in enumerate(noise):
            action = act(self.shown, disturbance, self.new)
            check_finite(action, self.seeds)
            taken = env_action(action, self.spec)
            write(steps.before, self.shown, time)
            steps.action[:, time], steps.taken[:, time] = action, taken
            self.step(taken)
            write(steps.after, self.shown, time)
            self.new = np.zeros(self.shape, bool)
            ended = np.logical_or(self.shown.terminated, self.shown.truncated)
            if ended.any():
                self.begin(ended.ravel())
        return steps

    def asked(self, answer: Callable[[], Timestep]) -> Timestep:
        """Call the environments; an error names the place where it occurred."""
        try:
            return answer()
        except EnvironmentFault as fault:
            raise fault if fault.place is None else EnvironmentFault(f"{fault}, {self.where(fault.place)}") from None

    def where(self, place: int) -> str:
        """The step, episode and seed of an environment, for messages."""
        among = f" in environment {place % self.environments}" if self.environments > 1 else ""
        return (
            f"at step {len(self.actions[place])} of episode {self.episode[place]} of seed {self.seed_of(place)}{among}"
        )

    def saved(self) -> dict[str, np.ndarray]:
        """All that is needed to restore the running episodes."""
        found = {"episode": self.episode.copy(), "new": self.new}
        observation = self.envs.batch.observation
        for number, actions in enumerate(self.actions):
            size = self.spec.agents, self.spec.action_size
            found[f"actions{number}"] = np.reshape(actions, (-1, *size))
            found[f"observation{number}"] = observation[number].copy()
        return found

    def restore(self, saved: dict[str, np.ndarray]) -> list[str]:
        """Restore the running episodes, by their seeds and actions.

        If that does not lead to the same observation, bit for bit, the environment is not deterministic: the episode is dropped,
        and a new one begins. Returns a message about each dropped episode, and sets `dropped`.
        """
        self.episode = saved["episode"].copy()
        count = len(self.episode)
        whole = [saved[f"actions{number}"] for number in range(count)]
        self.asked(lambda: self.envs.reset(np.ones(count, bool), self.episode_seeds()))
        lost = np.zeros(count, bool)
        for step in range(max(map(len, whole))):
            where = np.array([step < len(actions) for actions in whole]) & ~lost
            rows = np.stack([actions[min(step, len(actions) - 1)] if len(actions) else self.idle for actions in whole])
            shown = self.asked(lambda rows=rows, where=where: self.envs.step(rows, where))
            lost |= where & (shown.terminated | shown.truncated)
        self.actions, self.new = [list(actions) for actions in whole], saved["new"].copy()
        now = self.envs.batch.observation
        same = [np.array_equal(now[number], saved[f"observation{number}"]) for number in range(count)]
        self.dropped = lost | ~np.array(same)
        messages = [
            f"episode {self.episode[number]} of seed {self.seed_of(number)} was dropped after {len(whole[number])} steps: "
            "the same actions did not lead to the same observation again"
            for number in np.flatnonzero(self.dropped).tolist()
        ]
        if self.dropped.any():
            self.begin(self.dropped)
        return messages

    @property
    def idle(self) -> Float[np.ndarray, "agents action"]:
        """A placeholder action for an environment that is not stepped."""
        return np.zeros((self.spec.agents, self.spec.action_size), np.float32)


class HostCollector:
    """The training environments, the policy that acts in them, and environments to evaluate it in."""

    def __init__(self, envs: Envs, evaluation: Envs, config: TrainConfig, functions: Compiled, seeds: Sequence[int]):
        self.config, self.functions, self.seeds = config, functions, list(seeds)
        self.episodes, self.evaluation = HostEpisodes(envs, seeds, config.environments), evaluation
        self.memory = new_memory(config, *self.episodes.shape)
        self.episodes.begin()

    def collect(self, actor: Any, step: int) -> Trajectory:
        """The steps of the iteration that begins at this step; during the warmup, with random actions."""
        config, random = self.config, [generator(seed, Stream.EXPLORATION, step) for seed in self.seeds]
        shape = config.rollout_steps, config.environments, config.env.agents
        if step < config.warmup:
            uniform = [one.uniform(-1, 1, (*shape, config.env.action_size)) for one in random]
            return self.episodes.collect(lambda shown, noise, new: noise, np.stack(uniform, 1).astype(np.float32))
        noise = np.stack([host_noise(one, config.noise, (*shape, config.noise_size)) for one in random], 1)

        def act(shown: Timestep, noise: np.ndarray, new: np.ndarray) -> np.ndarray:
            given = self.memory, shown.observation, shown.available
            action, self.memory = self.functions.explore(actor, *given, noise, new)
            return np.asarray(action)

        return self.episodes.collect(act, noise)

    def evaluate(self, actor: Any, episodes: int) -> Evaluation:
        """Whole episodes of the policy, from the initial states of the run's evaluations."""
        act = policy(self.functions, self.config, actor, self.seeds, episodes)
        return evaluate(self.evaluation, act, self.seeds, episodes)

    def saved(self) -> dict[str, np.ndarray]:
        """Seeds and actions of the running episodes, and the actors' memory of them."""
        memory = {f"memory{place}": np.asarray(leaf) for place, leaf in enumerate(jax.tree.leaves(self.memory))}
        return self.episodes.saved() | memory

    def restore(self, saved: dict[str, np.ndarray]) -> tuple[Bool[np.ndarray, "seeds envs"], list[str]]:
        """Restore the running episodes. Returns which of them were dropped, and messages about these."""
        leaves, structure = jax.tree.flatten(self.memory)
        self.memory = jax.device_put(jax.tree.unflatten(structure, [saved[f"memory{i}"] for i in range(len(leaves))]))
        messages = self.episodes.restore(saved)
        return self.episodes.dropped.reshape(self.episodes.shape), messages

    def close(self) -> None:
        """Close the environments."""
        self.episodes.envs.close()
        self.evaluation.close()


def host_collector(
    task: TaskSpec, config: TrainConfig, functions: Compiled, seeds: Sequence[int], episodes: int
) -> HostCollector:
    """A collector with a task's environments: in this process, or in worker processes if a seed has several."""
    kind, maker = LocalEnvs if config.environments == 1 else WorkerEnvs, partial(make_host_env, task)
    envs, evaluation = (kind([maker] * (len(seeds) * count)) for count in (config.environments, episodes))
    return HostCollector(envs, evaluation, config, functions, seeds)


def policy(functions: Compiled, config: TrainConfig, actor: Any, seeds: Sequence[int], episodes: int) -> Acting:
    """The policy of all seeds, as in evaluations, for the given number of episodes of each seed, from their beginning."""
    memory = [new_memory(config, len(seeds), episodes)]
    random = [generator(seed, Stream.EVALUATION_NOISE, 0) for seed in seeds]

    def act(shown: Timestep, new: np.ndarray) -> np.ndarray:
        given = memory[0], shown.observation, shown.available, new
        action, memory[0] = evaluation_action(functions, config, actor, *given, random)
        return action

    return act


def evaluation_action(
    functions: Compiled,
    config: TrainConfig,
    actor: Any,
    memory: Any,
    observation: Float[np.ndarray, "seeds envs agents observation"],
    available: Bool[np.ndarray, "seeds envs agents action"],
    new: Bool[np.ndarray, "seeds envs"],
    random: Sequence[np.random.Generator],
) -> tuple[Float[np.ndarray, "seeds envs agents action"], Any]:
    """The actions of a policy as in evaluations, where only PPO's are random; and the policy's new memory."""
    given = actor, memory, observation, available
    if config.greedy:
        action, memory = functions.act(*given, None, new)
    else:
        shape = (*observation.shape[1:3], config.noise_size)
        noise = np.stack([host_noise(one, config.noise, shape) for one in random])
        action, memory = functions.explore(*given, noise, new)
    return np.asarray(action), memory


def shaped(rows: Timestep, shape: tuple[int, ...]) -> Timestep:
    """Views of the same arrays, by seeds and environments."""

    def view(leaf: np.ndarray) -> np.ndarray:
        return leaf.reshape(*shape, *leaf.shape[1:])

    *parts, measures = rows
    return Timestep(*map(view, parts), measures={name: view(values) for name, values in measures.items()})  # pyright: ignore


def blank_trajectory(spec: EnvSpec, shown: Timestep, shape: tuple[int, int], time: int) -> Trajectory:
    """An empty trajectory for so many steps."""
    seeds, environments = shape

    def rows(like: np.ndarray) -> np.ndarray:
        return np.zeros((seeds, time, environments, *like.shape[2:]), like.dtype)

    def timestep() -> Timestep:
        return jax.tree.map(rows, shown)

    action = np.zeros((seeds, time, environments, spec.agents, spec.action_size), np.float32)
    taken = action.astype(np.float32 if spec.discrete else spec.low.dtype)
    return Trajectory(timestep(), action, taken, timestep())


def write(rows: Timestep, shown: Timestep, time: int) -> None:
    """Copy a time step to its place in a trajectory."""
    *columns, measures = rows
    for column, value in zip(columns, shown, strict=False):
        column[:, time] = value
    for name, column in measures.items():
        column[:, time] = shown.measures[name]


def check_finite(action: Float[np.ndarray, "seeds *rest"], seeds: Sequence[int]) -> None:
    """Raise `Diverged` if the actions of a seed's policy are not finite."""
    for seed, chosen in zip(seeds, action, strict=True):
        if not np.isfinite(chosen).all():
            raise Diverged(
                f"training diverged: the policy of seed {seed} is not finite any more; the last checkpoint is whole"
            )


def evaluate(envs: Envs, act: Acting, seeds: Sequence[int], episodes: int, first: int = 0) -> Evaluation:
    """One episode in each environment, all in lockstep, each from its own initial state.

    The initial states depend only on the seed and on the episode's number, which counts from `first`. So every evaluation of a
    run begins from the same ones, and no training episode does.
    """
    spec, shape = envs.spec, (len(seeds), episodes)

    starts = [
        episode_seed(seed, Stream.EVALUATION_EPISODES, place)
        for seed in seeds
        for place in range(first, first + episodes)
    ]
    running, new = np.ones(len(starts), bool), np.ones(shape, bool)
    teams = len(spec.teams)
    returns, sums = np.zeros((*shape, teams)), np.zeros((*shape, teams))
    lengths = np.zeros(shape, int)
    measures = {name: np.full(shape, np.nan) for name in spec.measures}
    try:
        envs.reset(running, np.array(starts))
        shown = shaped(envs.batch, shape)
        while running.any():
            actions = act(shown, new)
            alive = shown.alive.copy()
            check_finite(actions, seeds)
            rows = env_action(actions, spec)
            envs.step(rows.reshape(-1, *rows.shape[2:]), running)
            now = running.reshape(shape)
            earned = shown.reward.astype(np.float64) * now[..., None]
            returns += np.stack([team_mean(earned, alive, team) for team in spec.teams], axis=-1)
            sums += np.stack([earned[..., team.agents].sum(axis=-1) for team in spec.teams], axis=-1)
            lengths += now
            ended = now & (shown.terminated | shown.truncated)
            for name, values in measures.items():
                values[ended] = shown.measures[name][ended]
            running, new = running & ~ended.ravel(), np.zeros_like(new)
    except EnvironmentFault as fault:
        where = "" if fault.place is None else f", in an evaluation of seed {seeds[fault.place // episodes]}"
        raise EnvironmentFault(f"{fault}{where}") from None
    return Evaluation(returns, sums, lengths, measures)

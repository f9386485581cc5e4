"""A run under way: the training state, the environments around it, one iteration of the work at a time."""

import contextlib
import ctypes
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from lare.algorithms.table import ALGORITHMS
from lare.credit.methods import find_method
from lare.data.trajectory import Trajectory
from lare.errors import LareError
from lare.latent.improve import Model
from lare.run import best as best_policies
from lare.run import checkpoint
from lare.run.best import Best
from lare.run.directory import Run
from lare.run.settings import ResolvedSettings
from lare.tasks.env import JaxEnv, Timestep
from lare.tasks.table import env_spec, make_env
from lare.training import first_fit, renew
from lare.training.annotate import annotate
from lare.training.collect_device import DeviceCollector
from lare.training.collect_host import HostCollector, host_collector
from lare.training.compiled import Compiled, compiled, new_learners
from lare.training.config import TrainConfig
from lare.training.learner import Learner, forget_episodes
from lare.training.seeds import lines
from lare.training.streams import Stream, seed_keys, stream_keys


def config_for(run: Run) -> TrainConfig:
    """What the run's compiled functions hold fixed."""
    task, settings, env = run.config.task, run.config.settings, env_spec(run.config.task)
    return TrainConfig(
        env=env,
        judged_from=task.judged_from,
        method=find_method(settings.method),
        algorithm=ALGORITHMS[settings.algorithm],
        hyperparameters=settings.hyperparameters,
        credit=settings.credit,
        scale_rewards=settings.scale_rewards,
        factors=tuple(function.size_by(run.judges) for function in run.functions),
        environments=settings.environments,
        rollout_steps=settings.rollout_steps,
        capacity=settings.rows(env.max_steps),
        steps=settings.steps,
        fit_updates=settings.fit_updates,
    )


@dataclass
class Session:
    """The training state, and what is around it on the host."""

    run: Run
    config: TrainConfig
    functions: Compiled
    learner: Learner
    collector: DeviceCollector | HostCollector
    step: int = 0
    """Environment steps done, of each seed."""
    metrics_length: int = 0
    """Bytes of metrics.jsonl that belong to the state."""
    fitted: bool = False
    """Whether the decoders' first fit has been made."""
    latest: dict[str, Float[Array, " seeds"]] = field(default_factory=dict)
    """What the last updates measured."""
    best: Best | None = None
    """Of the evaluations so far; None before the first, and where several teams learn, which are each other's measure."""

    @property
    def settings(self) -> ResolvedSettings:
        return self.run.config.settings

    @property
    def actor(self) -> Any:
        """What is needed to act now."""
        return self.functions.actor(self.learner, self.step)

    def advance(self) -> None:
        """One iteration: steps, factors, replay, sometimes the decoder, the algorithm."""
        steps = self.collector.collect(self.actor, self.step)
        self.learner = self.functions.store(self.learner, steps, annotate(self.run, self.config, steps))
        if self.learner.credit and np.any(steps.ended):
            self.learner = self.functions.learn_returns(self.learner)
        if self.step >= self.config.warmup:
            self.update(steps)
        self.step += self.settings.iteration_steps

    def update(self, steps: Trajectory) -> None:
        """The decoder's own updates, where it has any and their turn has come, and the algorithm's."""
        number = self.step // self.settings.iteration_steps
        fits = self.config.method.descends and not self.config.interleaved
        if fits and number % self.settings.fit_every == 0:
            self.fit(stream_keys(self.run.seeds, Stream.FIT, self.step))
        keys = seed_keys(jnp.asarray(self.run.seeds), self.step + 1)
        self.learner, learned = self.functions.improve(self.learner, steps, keys, self.step)
        if np.any(np.asarray(learned.get("algorithm/updates", 1)) > 0):
            self.latest |= learned

    def fit(self, keys: Key[Array, " seeds"]) -> None:
        """The decoder's own updates, the first time until they stop helping."""
        if self.settings.first_fit == "held-out" and not self.fitted and first_fit.has_enough(self.learner):
            self.learner, measured = first_fit.fit_until_it_stops_helping(
                self.learner, self.functions.fit, keys, self.config
            )
            self.fitted = True
        else:
            self.learner, measured = self.functions.fit(self.learner, keys)
        self.latest |= measured

    def report(self, rate: float) -> list[dict[str, Any]]:
        """Evaluate, always from the same starts; one line of metrics.jsonl for each seed."""
        evaluation = self.collector.evaluate(self.actor, self.settings.evaluation_episodes)
        if len(self.config.env.teams) == 1:
            self.keep_best(evaluation.returns[..., 0].mean(axis=1))
        measured = evaluation.metrics(self.config.env) | self.functions.assess(self.learner) | self.latest
        return lines(self.run.seeds, self.step, measured, rate)

    def keep_best(self, score: Float[np.ndarray, " seeds"]) -> None:
        """Keep the policies of the seeds that have never been evaluated better."""
        before = self.best or best_policies.none_yet(len(self.run.seeds))
        found = best_policies.better_of(before, score, self.step, self.actor)
        if np.any(found.score > before.score):
            best_policies.save(self.run.checkpoint, found)
        self.best = found

    def save(self, anew: bool = False) -> None:
        """Write a checkpoint; `anew` where stored rows have changed."""
        digests = [function.digest for function in self.run.functions]
        host = {"step": self.step, "metrics_length": self.metrics_length, "fitted": self.fitted}
        host |= {"functions_since": self.run.since, "function_sha256": digests}
        arrays = {f"latest/{name}": np.asarray(values) for name, values in self.latest.items()}
        arrays |= {f"collector/{name}": values for name, values in self.collector.saved().items()}
        checkpoint.save(self.run.checkpoint, self.learner, host, arrays, anew)

    def reflect(self, model: Model, said: Callable[[str], None]) -> None:
        """Ask for a better phi, and go on with it from here where it tells the stored returns better."""
        found = renew.reflected(self.run, self.config, self.learner, model, said)
        if [one.source for one in found] == [one.source for one in self.run.functions]:
            return
        self.run = renew.in_place_of(self.run, found, self.step)
        self.config = config_for(self.run)
        self.learner = renew.with_functions(self.run, self.config, self.learner)
        self.functions = compile_ahead(self.run, self.config, compiled(self.config))
        self.save(anew=True)

    def return_to(self, host: dict[str, Any], arrays: dict[str, np.ndarray]) -> list[str]:
        """Put everything around the learner back to a checkpoint; returns what is to be said about it."""
        self.step, self.metrics_length, self.fitted = host["step"], host["metrics_length"], host.get("fitted", False)
        self.latest = {name: jnp.asarray(values) for name, values in part(arrays, "latest/").items()}
        if (self.run.checkpoint / best_policies.FILE).exists():
            self.best = best_policies.load(self.run.checkpoint, actor_shape(self.run, self.config), self.run.seeds)
        dropped, messages = self.collector.restore(part(arrays, "collector/"))
        if dropped.any():
            self.learner = drop(self.learner, jnp.asarray(dropped))
            self.save()  # before a new episode is in the rows of the dropped one, which the checkpoint has as written
        return messages

    def close(self) -> None:
        """Close the environments."""
        self.collector.close()


def part(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin so, by the rest of their names."""
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}


drop = jax.jit(jax.vmap(forget_episodes))


def load_learner(run: Run) -> tuple[TrainConfig, Learner, dict[str, Any], dict[str, np.ndarray]]:
    """The training state of a run's last checkpoint, and what stood with it."""
    config = config_for(run)
    return config, *checkpoint.load(run.checkpoint, learner_shape(run, config))


def load_actor(run: Run, of_best: bool = False) -> tuple[TrainConfig, Any, Int[np.ndarray, " seeds"]]:
    """What is needed to act as a run acts at last or, of each seed, as in its best evaluation; and since which step it does.

    Raises:
        LareError: it has not been saved.
    """
    if of_best:
        config = config_for(run)
        found = best_policies.load(run.checkpoint, actor_shape(run, config), run.seeds)
        return config, jax.tree.map(jnp.asarray, found.actor), found.step
    config, learner, host, _ = load_learner(run)
    return config, compiled(config).actor(learner, host["step"]), np.full(len(run.seeds), host["step"])


def actor_shape(run: Run, config: TrainConfig) -> Any:
    """What is needed to act, with the shapes of its arrays in their place."""
    return jax.eval_shape(lambda learner: compiled(config).actor(learner, 0), learner_shape(run, config))


def learner_shape(run: Run, config: TrainConfig) -> Learner:
    """A learner with the shapes of its arrays in their place."""
    return jax.eval_shape(partial(new_learners, config=config), seed_keys(jnp.asarray(run.seeds), 0))


def new_learner(run: Run, config: TrainConfig) -> Learner:
    """An untrained learner."""
    keys = seed_keys(jnp.asarray(run.seeds), 0)
    made = ahead(jax.jit(partial(new_learners, config=config)), keys)
    give_memory_back()
    return made(keys)


def start(run: Run) -> Session:
    """A session before its first step."""
    config = config_for(run)
    return begin(run, config, partial(new_learner, run, config))


def restore(run: Run) -> tuple[Session, list[str]]:
    """A session as of the last checkpoint, and what is to be said about it."""
    config, learner, host, arrays = load_learner(run)
    session = begin(run, config, lambda: learner)
    try:
        return session, session.return_to(host, arrays)
    except checkpoint.DAMAGED as error:
        session.close()
        said = f"{type(error).__name__}: {error}"
        raise LareError(f"the checkpoint in {run.checkpoint} does not fit its environments: {said}") from error


def begin(run: Run, config: TrainConfig, make_learner: Callable[[], Learner]) -> Session:
    """Environments and compiled functions around a learner, which is made when they are there.

    The compiler needs hundreds of megabytes for a while; what it gives back in time holds the replay.
    """
    functions = compile_ahead(run, config, compiled(config))
    give_memory_back()
    learner = make_learner()
    if config.env.in_jax:
        env = make_env(run.config.task)
        assert isinstance(env, JaxEnv)
        return Session(run, config, functions, learner, DeviceCollector(env, config, run.seeds))
    episodes = run.config.settings.evaluation_episodes
    return Session(
        run, config, functions, learner, host_collector(run.config.task, config, functions, run.seeds, episodes)
    )


def compile_ahead(run: Run, config: TrainConfig, functions: Compiled) -> Compiled:
    """The functions of a run, compiled for the shapes that they will see."""
    lead = len(run.seeds), config.rollout_steps, config.environments
    env = config.env

    def shape(*sizes: int, dtype: Any = np.float32) -> Any:
        return jax.ShapeDtypeStruct((*lead, *sizes), dtype)

    action = shape(env.agents, env.action_size)
    flag = shape(dtype=np.bool_)
    shown = Timestep(
        observation=shape(env.agents, env.observation_size),
        state=shape(env.state_size),
        available=shape(env.agents, env.action_size, dtype=np.bool_),
        alive=shape(env.agents, dtype=np.bool_),
        reward=shape(env.agents),
        terminated=flag,
        truncated=flag,
        measures={name: shape() for name in env.measures},
    )
    taken = shape(env.agents, env.action_size, dtype=np.float32 if env.discrete else env.low.dtype)
    steps = Trajectory(shown, action, taken, shown)
    factors = shape(config.judged_rows, max(config.factors, default=0))
    learner, keys = learner_shape(run, config), jax.eval_shape(seed_keys, jnp.asarray(run.seeds), 0)
    return functions._replace(
        store=ahead(functions.store, learner, steps, factors),
        improve=ahead(functions.improve, learner, steps, keys, 0),
        assess=ahead(functions.assess, learner),
    )


def ahead(function: Any, *shapes: Any) -> Any:
    """A jitted function, compiled before it is called."""
    return function.lower(*shapes).compile()


def give_memory_back() -> None:
    """What the compiler has freed, glibc keeps for the process unless it is asked not to."""
    with contextlib.suppress(OSError, AttributeError):  # there is another C library, or none that can be asked
        ctypes.CDLL(None).malloc_trim(0)

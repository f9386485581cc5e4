"""A running training: the training state, its environments, and the functions that advance it by one iteration."""

import contextlib
import ctypes
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, Shaped

from lare_rl.algorithms.settings import OffPolicySettings
from lare_rl.algorithms.table import ALGORITHMS
from lare_rl.config.settings import ResolvedSettings
from lare_rl.credit.methods import find_method
from lare_rl.data import replay
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.families import env_spec, make_env
from lare_rl.envs.interface import JaxEnv, Timestep
from lare_rl.errors import LareError
from lare_rl.latent.improve import Model
from lare_rl.phi.graph import Graph
from lare_rl.runs import best_policy as best_policies
from lare_rl.runs import checkpoint
from lare_rl.runs.best_policy import Best
from lare_rl.runs.directory import Run
from lare_rl.training import advice, first_fit
from lare_rl.training import refresh as renew
from lare_rl.training.collect_device import DeviceCollector
from lare_rl.training.collect_host import HostCollector, host_collector
from lare_rl.training.compiled import Compiled, compiled
from lare_rl.training.factors import host_factors
from lare_rl.training.learner import Learner, forget_episodes
from lare_rl.training.seed_axis import lines
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import Stream, seed_keys, stream_keys
from lare_rl.util.provenance import source


def config_for(run: Run) -> TrainConfig:
    """The static configuration of the run's compiled functions."""
    task, settings, env = run.config.task, run.config.settings, env_spec(run.config.task)
    return TrainConfig(
        env=env,
        judged_from=task.judged_from,
        judges=run.judges,
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


def graphs(run: Run) -> tuple[Graph, ...]:
    """The graph of each team's phi."""
    return tuple(function.graph for function in run.functions)


@jax.jit
def in_first_environment(
    column: Shaped[Array, "seeds envs rows *rest"], rows: Int[Array, "seeds steps"]
) -> Shaped[Array, "seeds steps *rest"]:
    """Some rows of a column of the replay."""
    return jax.vmap(lambda of_seed, chosen: of_seed[0, chosen])(column, rows)


@dataclass
class Session:
    """The training state, and the objects on the host that belong to it."""

    run: Run
    config: TrainConfig
    functions: Compiled
    learner: Learner
    collector: DeviceCollector | HostCollector
    step: int = 0
    """Environment steps done, of each seed."""
    metrics_length: int = 0
    """The size of metrics.jsonl in bytes at this state."""
    fitted: bool = False
    """Whether the decoders' first fit has been made."""
    latest: dict[str, Float[Array, " seeds"]] = field(default_factory=dict)
    """The metrics of the last updates."""
    best: Best | None = None
    """The best evaluations so far; None before the first, and if several teams learn, whose returns depend on each other."""

    @property
    def settings(self) -> ResolvedSettings:
        return self.run.config.settings

    @property
    def actor(self) -> Any:
        """The parts of the learner that are needed to act now."""
        return self.functions.actor(self.learner, self.step)

    def advance(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """One iteration: collect steps, compute factors, store them, sometimes fit the decoder, update the algorithm.

        Args:
            stopped: whether the user has asked the run to stop.

        Raises:
            Stopped: the user has asked the run to stop, during the decoder's first fit. The session cannot go on.
        """
        steps = self.collector.collect(self.actor, self.step)
        self.learner, finite = self.functions.store(self.learner, steps)
        if self.run.functions and not np.all(finite):
            self.raise_not_finite(steps)
        if self.learner.credit and np.any(steps.ended):
            self.learner = self.functions.learn_returns(self.learner)
        if self.step >= self.config.warmup:
            self.update(steps, stopped)
        self.step += self.settings.iteration_steps

    def raise_not_finite(self, steps: Trajectory) -> None:
        """Raise `LareError` that names the factor which is not finite, and save its batch in the run directory."""
        host_factors(self.run, self.config, steps)
        raise LareError("a factor is not finite in the compiled function; the last checkpoint is whole")

    def update(self, steps: Trajectory, stopped: Callable[[], bool]) -> None:
        """Make the decoder's own updates, if it has any and they are due, and those of the algorithm."""
        number = self.step // self.settings.iteration_steps
        fits = self.config.method.descends and not self.config.interleaved
        if fits and number % self.settings.fit_every == 0:
            self.fit(stream_keys(self.run.seeds, Stream.FIT, self.step), stopped)
        keys = seed_keys(jnp.asarray(self.run.seeds), self.step + 1)
        self.learner, learned = self.functions.improve(self.learner, steps, keys, self.step)
        if np.any(np.asarray(learned.get("algorithm/updates", 1)) > 0):
            self.latest |= learned

    def fit(self, keys: Key[Array, " seeds"], stopped: Callable[[], bool]) -> None:
        """Make the decoder's own updates; the first time, until they bring no improvement."""
        if self.settings.first_fit == "held-out" and not self.fitted and first_fit.has_enough(self.learner):
            self.learner, measured = first_fit.fit_until_it_stops_helping(
                self.learner, compiled(first_fit.with_smaller_updates(self.config)).fit, keys, self.config, stopped
            )
            self.fitted = True
        else:
            self.learner, measured = self.functions.fit(self.learner, keys)
        self.latest |= measured

    def report(self, rate: float) -> list[dict[str, Any]]:
        """Evaluate, always from the same initial states; returns one line of metrics.jsonl for each seed."""
        evaluation = self.collector.evaluate(self.actor, self.settings.evaluation_episodes)
        if len(self.config.env.teams) == 1:
            self.keep_best(evaluation.returns[..., 0].mean(axis=1))
        measured = evaluation.metrics(self.config.env) | self.functions.assess(self.learner) | self.latest
        if self.step > self.config.warmup and isinstance(self.settings.hyperparameters, OffPolicySettings):
            measured |= {advice.SATURATION: advice.saturation(self.actions_now(advice.ROWS))}
        return lines(self.run.seeds, self.step, measured, rate)

    def actions_now(self, steps: int) -> Float[np.ndarray, "seeds steps action"]:
        """The actions of an off-policy algorithm's policies, without noise, in the newest states of the first environment.

        If fewer are stored, they are repeated: the shape, and so the compiled program, is always the same.
        """
        held = self.learner.replay
        rows = np.asarray(held.next_row)[:, :1] - 1 - np.arange(steps) % int(np.min(held.next_row))
        seen = in_first_environment(held.columns["observation"], rows % replay.capacity(held))
        available = np.ones((*rows.shape, 1, self.config.env.action_size), bool)
        action, _ = self.functions.act(self.actor, (), seen, available, None, np.zeros(rows.shape, bool))
        return np.asarray(action)[:, :, 0]

    def keep_best(self, score: Float[np.ndarray, " seeds"]) -> None:
        """Save the policies of the seeds whose evaluation is their best so far."""
        before = self.best or best_policies.none_yet(len(self.run.seeds))
        found = best_policies.better_of(before, score, self.step, self.actor)
        if np.any(found.score > before.score):
            best_policies.save(self.run.checkpoint, found)
        self.best = found

    def save(self, anew: bool = False) -> None:
        """Write a checkpoint; `anew` if stored rows have changed."""
        digests = [function.digest for function in self.run.functions]
        host = {"step": self.step, "metrics_length": self.metrics_length, "fitted": self.fitted}
        host |= {"functions_since": self.run.since, "function_sha256": digests}
        arrays = {f"latest/{name}": np.asarray(values) for name, values in self.latest.items()}
        arrays |= {f"collector/{name}": values for name, values in self.collector.saved().items()}
        checkpoint.save(self.run.checkpoint, self.learner, host, arrays, anew)

    def reflect(self, model: Model, said: Callable[[str], None]) -> None:
        """Ask a model for a better phi, and use it from now on if it explains the stored returns better."""
        found = renew.reflected(self.run, self.config, self.learner, model, said)
        if [one.source for one in found] == [one.source for one in self.run.functions]:
            return
        self.run = renew.in_place_of(self.run, found, self.step)
        self.config = config_for(self.run)
        self.learner = renew.with_functions(self.run, self.config, self.learner)
        self.functions = compile_ahead(self.run, self.config, compiled(self.config, graphs(self.run)))
        self.save(anew=True)

    def return_to(self, host: dict[str, Any], arrays: dict[str, np.ndarray]) -> list[str]:
        """Restore everything but the learner from a checkpoint; returns messages for the user."""
        self.step, self.metrics_length, self.fitted = host["step"], host["metrics_length"], host.get("fitted", False)
        self.latest = jax.device_put(part(arrays, "latest/"))
        if (self.run.checkpoint / best_policies.FILE).exists():
            self.best = best_policies.load(self.run.checkpoint, actor_shape(self.run, self.config), self.run.seeds)
        dropped, messages = self.collector.restore(part(arrays, "collector/"))
        if dropped.any():
            self.learner = drop(self.learner, jnp.asarray(dropped))
            self.save()  # now, because a new episode will overwrite rows that the checkpoint counts as saved
        return messages

    def close(self) -> None:
        """Close the environments."""
        self.collector.close()


def part(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}


drop = jax.jit(jax.vmap(forget_episodes))


def load_learner(run: Run) -> tuple[TrainConfig, Learner, dict[str, Any], dict[str, np.ndarray]]:
    """The training state of a run's last checkpoint, and the data that were saved with it.

    Raises:
        LareError: there is no checkpoint, it is damaged, or it is of a version of LaRe whose state has another structure.
    """
    config = config_for(run)
    try:
        return config, *checkpoint.load(run.checkpoint, learner_shape(run, compiled(config)))
    except LareError as error:
        if run.config.lare == source():
            raise
        raise LareError(f"{error}; the run is of LaRe {run.config.lare}, and this is LaRe {source()}") from error


def load_actor(run: Run, of_best: bool = False) -> tuple[TrainConfig, Any, Int[np.ndarray, " seeds"]]:
    """The actor of the last checkpoint or, for each seed, of its best evaluation; and the step at which it was saved.

    Raises:
        LareError: no actor has been saved.
    """
    if of_best:
        config = config_for(run)
        found = best_policies.load(run.checkpoint, actor_shape(run, config), run.seeds)
        return config, jax.device_put(found.actor), found.step
    config, learner, host, _ = load_learner(run)
    return config, compiled(config).actor(learner, host["step"]), np.full(len(run.seeds), host["step"])


def actor_shape(run: Run, config: TrainConfig) -> Any:
    """An actor, with shapes instead of arrays."""
    functions = compiled(config)
    return jax.eval_shape(lambda learner: functions.actor(learner, 0), learner_shape(run, functions))


def learner_shape(run: Run, functions: Compiled) -> Learner:
    """A learner, with shapes instead of arrays."""
    return jax.eval_shape(functions.init, seed_keys(jnp.asarray(run.seeds), 0))


def new_learner(run: Run, functions: Compiled) -> Learner:
    """An untrained learner."""
    keys = seed_keys(jnp.asarray(run.seeds), 0)
    made = ahead(functions.init, keys)
    give_memory_back()
    return made(keys)


def start(run: Run) -> Session:
    """A session before its first step."""
    config = config_for(run)
    return begin(run, config, partial(new_learner, run))


def restore(run: Run) -> tuple[Session, list[str]]:
    """A session at the last checkpoint, and messages for the user."""
    config, learner, host, arrays = load_learner(run)
    session = begin(run, config, lambda _: learner)
    try:
        return session, session.return_to(host, arrays)
    except checkpoint.DAMAGED as error:
        session.close()
        said = f"{type(error).__name__}: {error}"
        raise LareError(f"the checkpoint in {run.checkpoint} does not fit its environments: {said}") from error


def begin(run: Run, config: TrainConfig, make_learner: Callable[[Compiled], Learner]) -> Session:
    """A session with compiled functions, environments and a learner, which is made after the functions were compiled.

    The compiler needs hundreds of megabytes for a while. They are given back before the replay needs them.
    """
    functions = compile_ahead(run, config, compiled(config, graphs(run)))
    give_memory_back()
    learner = make_learner(functions)
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
    learner, keys = learner_shape(run, functions), jax.eval_shape(seed_keys, jnp.asarray(run.seeds), 0)
    return functions._replace(
        store=ahead(functions.store, learner, steps),
        improve=ahead(functions.improve, learner, steps, keys, 0),
        assess=ahead(functions.assess, learner),
    )


def ahead(function: Any, *shapes: Any) -> Any:
    """A jitted function, compiled before it is called."""
    return function.lower(*shapes).compile()


def give_memory_back() -> None:
    """Return memory that the compiler has freed to the system. Otherwise, glibc keeps it for the process."""
    with contextlib.suppress(OSError, AttributeError):  # another C library may not have this function
        ctypes.CDLL(None).malloc_trim(0)

"""A running training: its state, its environments, and the iterations of Algorithm 1 of the LaRe paper."""

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from lare_rl.algorithms.batches import Metrics
from lare_rl.algorithms.off_policy import OffPolicySettings
from lare_rl.config.settings import ResolvedSettings
from lare_rl.config.train_config import TrainConfig
from lare_rl.credit.explanation_text import MIN_EXPLAINED_EPISODES
from lare_rl.data.trajectory import Trajectory, empty_trajectory
from lare_rl.envs.workers import close_idle_workers
from lare_rl.errors import LareError
from lare_rl.runs import checkpoint
from lare_rl.runs.best_policy import BEST_FILE, BestPolicy, empty_best, load_best, save_best, update_best
from lare_rl.runs.directory import Run
from lare_rl.runs.metric_names import ACTOR_SATURATION, DETERMINISTIC_RETURN
from lare_rl.training.collect_device import DeviceCollector, is_reset_cheap, make_jax_env
from lare_rl.training.collect_host import HostCollector, make_host_collector
from lare_rl.training.compiled import (
    CompiledFunctions,
    LoopState,
    compile_ahead,
    compile_functions,
    compile_loop,
    init_seeds,
    learner_shape,
    merge_metrics,
)
from lare_rl.training.decoder_fits import config_of_first_fit, fit_until_converged, has_enough_episodes
from lare_rl.training.decoder_inputs import compute_host_factors
from lare_rl.training.divergence import check_losses
from lare_rl.training.evaluation import greedy_actions, metrics_lines, saturation
from lare_rl.training.explain import compile_explanation
from lare_rl.training.learner import Learner, abandon_episodes
from lare_rl.training.policy import actor_shape, get_actor
from lare_rl.training.rewards import team_metrics
from lare_rl.training.saved_state import load_learner, make_run_config
from lare_rl.training.seed_axis import count_seed_devices
from lare_rl.training.streams import Stream, seed_keys, stream_keys
from lare_rl.util.blas import load_linear_algebra, one_blas_thread
from lare_rl.util.npz import DAMAGED_FILE_ERRORS

__all__ = ["Session", "restore_session", "start_session"]

MAX_CALL_S = 5.0
"""About how long one compiled call may take. Until it returns, the user cannot stop the run."""


@dataclass
class Session:
    """The training state, and the objects on the host that belong to it."""

    run: Run
    config: TrainConfig
    functions: CompiledFunctions
    learner: Learner
    collector: DeviceCollector | HostCollector
    loop: Callable[..., LoopState] | None = None
    """Iterations as one compiled call, for an environment of pure functions."""
    step: int = 0
    """Environment steps done, of each seed."""
    metrics_bytes: int = 0
    """The size of metrics.jsonl in bytes at this state."""
    first_fit_done: bool = False
    """Whether the decoders' first fit has been made."""
    latest_metrics: Metrics = field(default_factory=dict)
    """The metrics of the last updates."""
    best: BestPolicy | None = None
    """The best evaluations so far. None before the first evaluation, and always with several teams, whose returns depend on each
    other."""

    _unchecked: tuple[Any, Trajectory] | None = None
    """Whether all factors of the newest steps are finite, for each seed; and these steps."""
    _threads: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(3))
    """Threads that write checkpoints, update while steps are collected, and compile."""
    _saving: Future[None] | None = None
    """The checkpoint that is being written."""
    _iteration_s: float = MAX_CALL_S
    """Seconds of an iteration in the last compiled call. By its initial value, the first call makes a single iteration."""
    _stop_requested: Callable[[], bool] = field(default=lambda: False)
    """Whether the user has asked the run to stop."""

    @property
    def settings(self) -> ResolvedSettings:
        return self.run.config.settings

    @property
    def actor(self) -> Any:
        """What is needed to act now, of all seeds."""
        return get_actor(self.learner.algorithm, self.step, self.config)

    def watch(self, on_step: Callable[[int], None], stop_requested: Callable[[], bool]) -> None:
        """Set what is called while environments step on the host, and what returns whether the user has asked the run to stop."""
        self._stop_requested = stop_requested
        if isinstance(self.collector, HostCollector):
            self.collector.watch(on_step, stop_requested)

    def advance(self, until: int) -> None:
        """Make iterations: one on the host, or several in one compiled call, but none beyond step `until`.

        Raises:
            FirstFitStoppedError: the user has asked the run to stop, during the decoder's first fit. The session cannot
                continue.
        """
        if self.loop is not None and not self._is_before_first_fit:
            self._iterate_compiled(self.loop, (until - self.step) // self.config.iteration_steps)
            return
        if self.settings.overlap_collection:
            # The policy from before the update collects. It is a copy, because the update reuses the learner's memory.
            actor, config = jax.tree.map(jnp.copy, self.actor), self.config
            # In a thread, because the call of an update returns when the device has nearly finished it. It reads only stored steps.
            no_steps = empty_trajectory(config.env, len(self.run.seeds), config.rollout_steps, config.n_envs)
            updating = self._threads.submit(self._update, no_steps)
            steps = self.collector.collect(actor, self.step)
            updating.result()
            self._store(steps)
        else:
            steps = self.collector.collect(self.actor, self.step)
            self._store(steps)
            self._update(steps)
        self.step += self.config.iteration_steps

    @property
    def _is_before_first_fit(self) -> bool:
        """Whether the decoders' first fit is still to be made. The host decides when it ends."""
        return self.config.has_first_fit and not self.first_fit_done

    def _iterate_compiled(self, loop: Callable[..., LoopState], max_iterations: int) -> None:
        """Make iterations in one compiled call, for about `MAX_CALL_S`."""
        assert isinstance(self.collector, DeviceCollector)
        n_iterations = max(1, min(max_iterations, int(MAX_CALL_S / self._iteration_s)))
        start = time.perf_counter()
        seeds, n_done = jnp.asarray(self.run.seeds), self.step // self.config.iteration_steps
        with one_blas_thread():
            state = loop(self.learner, self.collector.envs, self.latest_metrics, seeds, n_done, n_iterations)
            is_measured, is_finite = jax.device_get((state.is_measured, state.is_finite))
        self._iteration_s = max(1e-6, (time.perf_counter() - start) / n_iterations)
        self.learner, self.collector.envs = state.learner, state.envs
        self._unchecked = is_finite, state.steps
        self._check_factors()
        self.latest_metrics |= {name: state.metrics[name] for name, by_seed in is_measured.items() if by_seed.any()}
        self.step += n_iterations * self.config.iteration_steps

    def _store(self, steps: Trajectory) -> None:
        """Store new steps, and let the decoders learn from episodes that have finished."""
        self._check_factors()
        self.learner, is_finite = self.functions.store(self.learner, steps)
        if self.config.method.fit is not None and (steps.ended.any() or not self.config.payments.only_at_end):
            self.learner = self.functions.learn_returns(self.learner)
        self._unchecked = is_finite, steps

    def _update(self, steps: Trajectory) -> None:
        """Make the decoders' own updates if they are due, and then update the algorithm. Do nothing during the warmup."""
        config, seeds = self.config, jnp.asarray(self.run.seeds)
        if self.step < config.warmup:
            return
        if config.fits_separately and self.step // config.iteration_steps % config.fit_every == 0:
            self._fit(stream_keys(seeds, Stream.FIT, self.step))
        keys = seed_keys(seeds, self.step + 1)
        self.learner, metrics = self.functions.train_step(self.learner, steps, keys, self.step)
        metrics, is_new = merge_metrics(self.latest_metrics, metrics)
        if np.any(is_new):
            self.latest_metrics = metrics

    def _fit(self, keys: Key[Array, " seeds"]) -> None:
        """Fit the decoders. The first fit lasts until it brings no improvement."""
        if self._is_before_first_fit and has_enough_episodes(self.learner):
            fit = compile_functions(config_of_first_fit(self.config)).fit
            self.learner, metrics = fit_until_converged(self.learner, fit, keys, self.config, self._stop_requested)
            self.first_fit_done = True
        else:
            self.learner, metrics = self.functions.fit(self.learner, keys)
        self.latest_metrics |= metrics

    def _check_factors(self) -> None:
        """Raise `LareError` if a factor of the newest steps is not finite.

        The steps of an iteration are checked in the next one, so that the host need not wait for the device.
        """
        if self._unchecked is None:
            return
        (is_finite, steps), self._unchecked = self._unchecked, None
        if self.run.functions and not np.all(is_finite):
            compute_host_factors(self.run, self.config, steps)  # raises an error that names the factor
            raise LareError(
                "a factor is finite in NumPy, and not in the compiled function: write phi without numbers that are too large for "
                "float32; the last checkpoint is intact"
            )

    def _compile_while_collecting(self) -> None:
        """Compile in threads what the first finished episodes need. Until then, the processor often waits for a simulator.

        Errors are ignored here: the call that needs the program compiles again.
        """
        shape = learner_shape(self.config, len(self.run.seeds))
        load_linear_algebra()
        self._threads.submit(self.functions.compile_learning, shape)
        # A shorter run may have too few episodes to explain.
        is_explained = self.settings.steps >= MIN_EXPLAINED_EPISODES * self.config.env.max_steps
        if is_explained and self.config.n_devices == 1:
            self._threads.submit(compile_explanation, shape, self.config)

    def evaluate(self, rate: float) -> list[dict[str, Any]]:
        """Evaluate, always from the same initial states, and keep the best policies. `rate` is in steps per second.

        Returns:
            One line of metrics.jsonl for each seed.

        Raises:
            LareError: a policy, a loss or a factor is not finite, an environment fails, or the best policies cannot be written.
        """
        self._check_factors()
        check_losses(self.latest_metrics, self.run.seeds, self.step)
        actor, n_episodes = self.actor, self.settings.evaluation_episodes
        evaluation = self.collector.evaluate(actor, n_episodes)
        if len(self.config.env.teams) == 1:
            self._keep_best(evaluation.returns[..., 0].mean(axis=1), actor)
        metrics = evaluation.drop_group(self.run.config.task).metrics(self.config.env)
        metrics |= self.functions.assess(self.learner) | self.latest_metrics
        is_last, is_sampled = self.step == self.settings.steps, not self.config.deterministic_evaluation
        # Only at the end, because it takes as long as the evaluation of sampled actions. Not in JAX, where another program would have to be
        # compiled.
        if is_last and is_sampled and isinstance(self.collector, HostCollector):
            means = self.collector.evaluate(actor, n_episodes, deterministic=True).returns.mean(axis=1)
            metrics |= team_metrics([{DETERMINISTIC_RETURN: mean} for mean in means.T], self.config.env.teams)
        if self.step > self.settings.warmup and isinstance(self.settings.hyperparameters, OffPolicySettings):
            metrics[ACTOR_SATURATION] = saturation(greedy_actions(actor, self.learner.replay, self.config))
        return metrics_lines(self.run.seeds, self.step, metrics, rate)

    def _keep_best(self, score: Float[np.ndarray, " seeds"], actor: Any) -> None:
        """Save the policies of the seeds whose evaluation is their best so far."""
        old = self.best or empty_best(len(self.run.seeds))
        self.best = update_best(old, score, self.step, actor)
        if np.any(self.best.return_ > old.return_):
            save_best(self.run.checkpoint, self.best)

    def save(self) -> None:
        """Write a checkpoint, while the run goes on. `finish_saving` waits until it is written.

        Raises:
            LareError: the last checkpoint could not be written, or a factor or a loss is not finite.
        """
        self._check_factors()
        check_losses(self.latest_metrics, self.run.seeds, self.step)
        self.finish_saving()
        metadata = {
            "step": self.step,
            "metrics_length": self.metrics_bytes,
            "fitted": self.first_fit_done,
            "function_sha256": [function.digest for function in self.run.functions],
        }
        arrays = {f"latest/{name}": np.asarray(values) for name, values in self.latest_metrics.items()}
        arrays |= {f"collector/{name}": values for name, values in self.collector.state_dict().items()}
        snapshot = checkpoint.take_snapshot(self.run.checkpoint, self.learner, metadata, arrays)
        self._saving = self._threads.submit(checkpoint.write, self.run.checkpoint, snapshot)

    def finish_saving(self) -> None:
        """Wait until the last checkpoint is written. Raises `LareError` if it cannot be written."""
        if self._saving is not None:
            saving, self._saving = self._saving, None
            saving.result()

    def restore(self, metadata: dict[str, Any], arrays: dict[str, np.ndarray]) -> list[str]:
        """Restore everything but the learner from a checkpoint. Return messages for the user."""
        self.step, self.metrics_bytes = metadata["step"], metadata["metrics_length"]
        self.first_fit_done = metadata.get("fitted", False)
        self.latest_metrics = jax.device_put(_select_prefix(arrays, "latest/"))
        messages = self._restore_best() if (self.run.checkpoint / BEST_FILE).exists() else []
        dropped, lost_episodes = self.collector.restore(_select_prefix(arrays, "collector/"))
        if dropped.any():
            self.learner = jax.jit(jax.vmap(abandon_episodes))(self.learner, jnp.asarray(dropped))
            self.save()  # now, because a new episode will overwrite rows that the checkpoint counts as saved
            self.finish_saving()
        return messages + lost_episodes

    def _restore_best(self) -> list[str]:
        """Restore the best policies. Training does not need them: if they cannot be read, it goes on without those so far."""
        n_seeds = len(self.run.seeds)
        try:
            self.best = load_best(self.run.checkpoint, actor_shape(self.config, n_seeds), n_seeds)
        except LareError as error:
            return [f"the best policies so far are lost, and only later evaluations choose new ones: {error}"]
        return []

    def close(self) -> None:
        """Close the environments and worker processes, and finish the last checkpoint. Raises `LareError` if it cannot be written."""
        try:
            if isinstance(self.collector, HostCollector):
                self.collector.close()
        finally:
            self._threads.shutdown()
            close_idle_workers()
            self.finish_saving()


def start_session(run: Run) -> Session:
    """Return a session before its first step."""
    n_devices = count_seed_devices(len(run.seeds))
    return _make_session(run, make_run_config(run, n_devices), None)


def restore_session(run: Run) -> tuple[Session, list[str]]:
    """Return a session at the last checkpoint, and messages for the user.

    Raises:
        LareError: there is no checkpoint, or it cannot be used.
    """
    config, learner, metadata, arrays = load_learner(run, count_seed_devices(len(run.seeds)))
    session = _make_session(run, config, learner)
    try:
        return session, session.restore(metadata, arrays)
    except BaseException as error:
        session.close()
        if not isinstance(error, DAMAGED_FILE_ERRORS):
            raise
        raise LareError(
            f"the checkpoint in {run.checkpoint} does not fit its environments ({type(error).__name__}: {error}): start a new run, or "
            "install the version that the run names"
        ) from error


def _make_session(run: Run, config: TrainConfig, learner: Learner | None) -> Session:
    """Compile the functions of a session and make its environments. Without a learner, start with an untrained one."""
    task, n_seeds = run.config.task, len(run.seeds)
    env = make_jax_env(task) if config.env.is_jax else None
    if env is not None and config.vectorized:
        n_envs = config.n_envs * n_seeds // config.n_devices
        config = replace(config, resets_with_steps=is_reset_cheap(env, n_envs))
    iterates_on_host = env is None or config.has_first_fit
    functions = compile_ahead(config, run.graphs, n_seeds, iterates_on_host=iterates_on_host)
    loop = None if env is None else compile_loop(env, config, run.graphs, n_seeds)
    learner = learner or init_seeds(functions, seed_keys(jnp.asarray(run.seeds), 0))
    if env is not None:
        return Session(run, config, functions, learner, DeviceCollector(env, config, run.seeds), loop)
    collector = make_host_collector(task, config, run.seeds, run.config.settings.evaluation_episodes)
    session = Session(run, config, functions, learner, collector)
    if config.method.fit is not None:
        session._compile_while_collecting()
    return session


def _select_prefix(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """Return the arrays whose names begin with a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}

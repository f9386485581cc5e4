"""Several `HostEnv`s, stepped in lockstep: in this process (`LocalVecEnv`) or in others (`workers.SubprocVecEnv`)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Integer, Shaped

from lare_rl.envs.env_errors import EnvOutputError, check_finite, close_env, one_line_errors
from lare_rl.envs.interface import EnvSpec, HostEnv, JaxEnv, Timestep
from lare_rl.errors import LareError, short_repr

__all__ = [
    "LocalVecEnv",
    "Maker",
    "VecEnv",
    "call_env",
    "check_jax_env",
    "check_lengths",
    "check_same_sizes",
    "empty_batch",
    "first_timestep",
    "make_env_at",
]

Maker = Callable[[], HostEnv]


class VecEnv(ABC):
    """n environments with the same sizes. In training, n is the number of seeds times the environments of a seed, seeds first.

    The mask `where` selects environments: the rows of the others do not change. The next call overwrites the returned arrays. The
    caller resets environments whose episode has ended.
    """

    stop_requested: Callable[[], bool] = staticmethod(lambda: False)
    """Whether the user wants to stop. Environments in other processes must then reply soon."""

    def __init__(self, spec: EnvSpec, batch: Timestep):
        self.spec = spec
        self.batch = batch
        """The last timestep of each environment."""
        self._length = np.zeros(len(batch.terminated), int)
        """The number of steps of each environment's running episode."""

    def reset(self, where: Bool[np.ndarray, " n"], seeds: Integer[np.ndarray, " n"]) -> Timestep:
        """Start an episode in the selected environments."""
        self._call("reset", seeds, where)
        self._length[where] = 0
        return self._check_lengths()

    def step(
        self, action: Float[np.ndarray, "n agents action"], where: Bool[np.ndarray, " n"] | None = None
    ) -> Timestep:
        """Make one step in the selected environments, by default in all. Actions are in the environment's units."""
        where = np.ones(len(action), bool) if where is None else where
        self._call("step", action, where)
        self._length[where] += 1
        return self._check_lengths()

    def _check_lengths(self) -> Timestep:
        check_lengths(self.spec, self._length, np.logical_or(self.batch.terminated, self.batch.truncated))
        return self.batch

    @abstractmethod
    def _call(self, command: str, arguments: Shaped[np.ndarray, "n *rest"], where: Bool[np.ndarray, " n"]) -> None:
        """Call "reset" or "step" of the selected environments, and write their timesteps into the batch."""

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class LocalVecEnv(VecEnv):
    """Environments in this process, stepped one after the other."""

    def __init__(self, makers: Sequence[Maker]):
        self._envs: list[HostEnv] = []
        try:
            for index, maker in enumerate(makers):
                self._envs.append(make_env_at(index, maker))
            specs = [env.spec for env in self._envs]
            check_same_sizes(specs)
        except BaseException:
            self.close()
            raise
        super().__init__(specs[0], empty_batch(specs[0], len(specs)))

    def _call(self, command: str, arguments: Shaped[np.ndarray, "n *rest"], where: Bool[np.ndarray, " n"]) -> None:
        for index in np.flatnonzero(where).tolist():
            # A copy: an environment may change its action in place.
            call_env(index, self._envs[index], command, np.copy(arguments[index]), self.batch)

    def close(self) -> None:
        for index, env in enumerate(self._envs):
            close_env(env, f"environment {index}")


def make_env_at(env_index: int, maker: Maker) -> HostEnv:
    """Make an environment. Raises `LareError` with its index if that fails."""
    with one_line_errors(f"environment {env_index} cannot be made"):
        return maker()


def check_lengths(spec: EnvSpec, length: Integer[np.ndarray, " n"], ended: Bool[np.ndarray, " n"]) -> None:
    """Raise `EnvOutputError` if an episode is longer or shorter than the specification says.

    `length` is the number of steps of each episode until now, and `ended` says whether it has ended.
    """
    at_limit = length >= spec.max_steps
    wrong = (at_limit != ended) if spec.fixed_length else (at_limit & ~ended)
    if wrong.any():
        index = int(np.argmax(wrong))
        problem = f"has {length[index]} steps and has not ended, but max_steps is {spec.max_steps}"
        if ended[index]:
            problem = f"ended after {length[index]} steps, but fixed_length says that all have {spec.max_steps}"
        raise EnvOutputError(f"the environment: the episode {problem}", index)


def check_jax_env(env: JaxEnv, owner: str) -> None:
    """Raise `LareError` if `reset` or `step` fails, or returns a timestep that does not match the specification."""
    import jax  # worker processes import this module and do without JAX

    batch, key = empty_batch(env.spec, 1), jax.random.key(0)
    action = jax.ShapeDtypeStruct((env.spec.n_agents, env.spec.action_size), np.float32)
    with one_line_errors(f"environment {owner!r} cannot be compiled"):
        state, first = jax.eval_shape(env.reset, key)
        _, second = jax.eval_shape(env.step, state, action, key)
    for function, timestep in (("reset", first), ("step", second)):
        _check_shapes(timestep, batch, owner, function)
        for name, column, value in zip(Timestep._fields[:-1], batch[:-1], timestep[:-1], strict=True):
            if value.dtype != column.dtype:
                raise EnvOutputError(f"{owner}: {name} of {function} has the type {value.dtype}, not {column.dtype}")
        for name in batch.measures.keys() - timestep.measures.keys():
            raise EnvOutputError(f"{owner}: {function} returns no measure {name!r}, which its spec names")


def _check_shapes(timestep: Any, batch: Timestep, owner: str, function: str) -> None:
    """Raise `EnvOutputError` if the arrays of a timestep have other shapes than the rows of a batch."""
    if not isinstance(timestep, Timestep):
        raise EnvOutputError(f"{owner}: {function} must return a Timestep, not {short_repr(timestep)}")
    if not isinstance(timestep.measures, Mapping):
        raise EnvOutputError(
            f"{owner}: measures of {function} must be a dictionary, not {short_repr(timestep.measures)}"
        )
    (*columns, _), (*values, _) = batch, timestep
    for name, column, value in zip(Timestep._fields, columns, values, strict=False):
        if np.shape(value) != column.shape[1:]:
            shapes = f"{np.shape(value)}, not {column.shape[1:]}"
            raise EnvOutputError(f"{owner}: {name} of {function} has the shape {shapes}")


def call_env(env_index: int, env: HostEnv, command: str, argument: Any, batch: Timestep) -> None:
    """Call "reset" or "step" of an environment, check its timestep, and write it into a row of the batch.

    An `EnvOutputError` has the index only as `env_index`: the caller names the environment in the message.
    """
    *columns, measures = batch
    owner = "the environment"
    try:
        with one_line_errors(f"environment {env_index} failed in {command}"):
            timestep = env.reset(int(argument)) if command == "reset" else env.step(argument)
            _check_shapes(timestep, batch, owner, command)
            *values, new_measures = timestep
            for column, value in zip(columns, values, strict=True):
                column[env_index] = value
            # In the batch, numbers beyond float32 are infinite.
            row = Timestep(*(column[env_index] for column in columns), measures={})
            check_finite(row, env.spec, owner)
            for name, value in new_measures.items():
                if name not in measures:
                    raise EnvOutputError(f"{owner}: the measure {name!r} is not in EnvSpec.measures")
                measures[name][env_index] = value
            missing = sorted(measures.keys() - new_measures.keys())
            # The value of an earlier episode is still in the batch.
            if missing and (timestep.terminated or timestep.truncated):
                raise EnvOutputError(
                    f"{owner}: the last step has no measure {missing[0]!r}, which EnvSpec.measures has"
                )
    except EnvOutputError as error:
        error.env_index = env_index
        raise


def check_same_sizes(specs: Sequence[EnvSpec]) -> None:
    """Raise `LareError` if environments have different sizes."""
    read_sizes = attrgetter("teams", "observation_size", "action_size", "discrete", "state_size", "measures")
    first, *rest = map(read_sizes, specs)
    for env_index, sizes in enumerate(rest, 1):
        if sizes != first:
            raise LareError(f"environment {env_index} differs from environment 0: {sizes}, not {first}")


def empty_batch(spec: EnvSpec, *batch_shape: int) -> Timestep:
    """Return the timesteps of a batch of environments before their first reset."""
    return Timestep(
        observation=np.zeros((*batch_shape, spec.n_agents, spec.observation_size), np.float32),
        state=np.zeros((*batch_shape, spec.state_size), np.float32),
        available=np.ones((*batch_shape, spec.n_agents, spec.action_size), bool),
        alive=np.zeros((*batch_shape, spec.n_agents), bool),
        reward=np.zeros((*batch_shape, spec.n_agents), np.float32),
        terminated=np.zeros(batch_shape, bool),
        truncated=np.zeros(batch_shape, bool),
        measures={name: np.zeros(batch_shape, np.float32) for name in spec.measures},
    )


def first_timestep(batch: Timestep) -> Timestep:
    """Return a copy of the timestep of the first environment of a batch."""
    *columns, measures = batch
    return Timestep(*(column[0].copy() for column in columns), {name: value[0] for name, value in measures.items()})  # pyright: ignore[reportCallIssue]

"""Many copies of a `HostEnv`, stepped in lockstep. `LocalVecEnv` has them in this process, `workers.SubprocVecEnv` in others."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Integer, Shaped

from lare_rl.envs.env_errors import EnvOutputError, check_finite, one_line_errors
from lare_rl.envs.interface import EnvSpec, HostEnv, Timestep
from lare_rl.errors import LareError, short_repr

__all__ = ["LocalVecEnv", "Maker", "VecEnv", "call_env", "check_same_sizes", "empty_batch", "make_env_at"]

Maker = Callable[[], HostEnv]


class VecEnv(ABC):
    """n environments with the same sizes. In training, n is the number of seeds times the environments of a seed, seeds first.

    `where` selects environments: the rows of the others do not change. The next call overwrites the returned arrays. Environments whose
    episode has ended are not reset: the caller does it.
    """

    stop_requested: Callable[[], bool] = staticmethod(lambda: False)
    """Whether the user wants to stop. Environments in other processes must then reply soon; `LocalVecEnv` ignores it."""

    def __init__(self, spec: EnvSpec, batch: Timestep):
        self.spec = spec
        self.batch = batch
        """The last timestep of each environment."""
        self._length = np.zeros(len(batch.terminated), int)
        """The steps of each environment's running episode."""

    def reset(self, where: Bool[np.ndarray, " n"], seeds: Integer[np.ndarray, " n"]) -> Timestep:
        """Start an episode in the selected environments."""
        self._call("reset", seeds, where)
        self._length[where] = 0
        self._check(where)
        return self.batch

    def step(
        self, action: Float[np.ndarray, "n agents action"], where: Bool[np.ndarray, " n"] | None = None
    ) -> Timestep:
        """Make one step in the selected environments, by default in all. Actions are in the environment's units."""
        where = np.ones(len(action), bool) if where is None else where
        self._call("step", action, where)
        self._length[where] += 1
        self._check(where)
        return self.batch

    def _check(self, where: Bool[np.ndarray, " n"]) -> None:
        """Raise `EnvOutputError` if an episode is longer or shorter than the specification says."""
        max_steps, ended = self.spec.max_steps, np.logical_or(self.batch.terminated, self.batch.truncated)
        at_limit = self._length >= max_steps
        invalid = where & ((at_limit != ended) if self.spec.fixed_length else (at_limit & ~ended))
        if invalid.any():
            index = int(np.argmax(invalid))
            length = int(self._length[index])
            problem = f"the episode has {length} steps and has not ended, but max_steps is {max_steps}"
            if ended[index]:
                problem = f"the episode ended after {length} steps, but fixed_length says that all have {max_steps}"
            error = EnvOutputError(f"environment {index}: {problem}")
            error.env_index = index
            raise error

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
        self._envs = [make_env_at(index, maker) for index, maker in enumerate(makers)]
        specs = [env.spec for env in self._envs]
        check_same_sizes(specs)
        super().__init__(specs[0], empty_batch(specs[0], len(specs)))

    def _call(self, command: str, arguments: Shaped[np.ndarray, "n *rest"], where: Bool[np.ndarray, " n"]) -> None:
        for index in np.flatnonzero(where).tolist():
            call_env(index, self._envs[index], command, arguments[index], self.batch)

    def close(self) -> None:
        for env in self._envs:
            env.close()


def make_env_at(env_index: int, maker: Maker) -> HostEnv:
    """Make an environment. Its errors become one line with its index."""
    with one_line_errors(f"environment {env_index} cannot be made"):
        return maker()


def call_env(env_index: int, env: HostEnv, command: str, argument: Any, batch: Timestep) -> None:
    """Call "reset" or "step" of an environment, check its timestep, and write it into a row of the batch."""
    *columns, measures = batch
    try:
        with one_line_errors(f"environment {env_index} failed in {command}"):
            timestep = env.reset(int(argument)) if command == "reset" else env.step(argument)
            if not isinstance(timestep, Timestep):
                raise EnvOutputError(
                    f"environment {env_index}: {command} must return a Timestep, not {short_repr(timestep)}"
                )
            *values, new_measures = timestep
            for name, column, value in zip(Timestep._fields, columns, values, strict=False):
                if np.shape(value) != column.shape[1:]:
                    shapes = f"{np.shape(value)}, not {column.shape[1:]}"
                    raise EnvOutputError(f"environment {env_index}: {name} has the shape {shapes}")
                column[env_index] = value
            row = Timestep(*(column[env_index] for column in columns), measures={})  # as float32, which may be infinite
            check_finite(row, env.spec, f"environment {env_index}")
            for name, value in new_measures.items():
                if name not in measures:
                    raise EnvOutputError(f"environment {env_index}: the measure {name!r} is not in EnvSpec.measures")
                measures[name][env_index] = value
    except EnvOutputError as error:
        error.env_index = env_index
        raise


def check_same_sizes(specs: Sequence[EnvSpec]) -> None:
    """Raise `LareError` if environments have different sizes."""
    first, *rest = map(_sizes, specs)
    for env_index, sizes in enumerate(rest, 1):
        if sizes != first:
            raise LareError(f"environment {env_index} differs from environment 0: {sizes}, not {first}")


def _sizes(spec: EnvSpec) -> tuple[Any, ...]:
    return spec.teams, spec.observation_size, spec.action_size, spec.discrete, spec.state_size, spec.measures


def empty_batch(spec: EnvSpec, *lead: int) -> Timestep:
    """Return the timesteps of environments before their first reset, as arrays of shape `lead`."""
    return Timestep(
        observation=np.zeros((*lead, spec.n_agents, spec.observation_size), np.float32),
        state=np.zeros((*lead, spec.state_size), np.float32),
        available=np.ones((*lead, spec.n_agents, spec.action_size), bool),
        alive=np.zeros((*lead, spec.n_agents), bool),
        reward=np.zeros((*lead, spec.n_agents), np.float32),
        terminated=np.zeros(lead, bool),
        truncated=np.zeros(lead, bool),
        measures={name: np.zeros(lead, np.float32) for name in spec.measures},
    )

"""What the adapters of JAX packages share: imports, flat observations, actions, the adapter of a single agent, and pictures."""

import contextlib
import importlib
import io
import math
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from lare_rl.envs.env_errors import as_lare_error, one_line_errors
from lare_rl.envs.interface import EnvSpec, Team, Timestep, to_package_action, with_available_action
from lare_rl.envs.mujoco_warnings import mujoco_warnings
from lare_rl.errors import LareError, did_you_mean, install_command, missing_extra_error, short_repr
from lare_rl.tasks.spec import TaskSpec

__all__ = [
    "TRAINABLE_ACTIONS",
    "AgentEnv",
    "action_fields",
    "agent_timestep",
    "bounded_action",
    "cast_like",
    "construct",
    "draw_states",
    "draw_updates",
    "find_measures",
    "flat_size",
    "flatten_tree",
    "import_package",
    "mask_combinations",
    "raw_key",
    "read_measures",
    "unusable_error",
]

MAX_COMBINATIONS = 1024
"""The largest number of discrete actions that may stand for the combinations of a multi-discrete action."""
TRAINABLE_ACTIONS = "LaRe trains discrete actions and bounded continuous ones"


# Packages


def import_package(name: str, task: TaskSpec) -> ModuleType:
    """Import the package of an environment, and hide what it prints. Raises `LareError`, which names the extra, if that fails."""
    try:
        with _silence():
            return importlib.import_module(name)
    except Exception as error:  # an old package may raise anything if a newer JAX has removed a name
        if isinstance(error, ModuleNotFoundError) and error.name in (name, name.partition(".")[0]):
            raise missing_extra_error(f"environment {task.environment!r}", task.family) from error
        raise as_lare_error(f"{name} cannot be imported", error, f" (try {install_command(task.family)})") from error


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Hide what packages print and warn of. JaxMARL prints to `sys.__stdout__`."""
    originals, silence = (sys.__stdout__, sys.__stderr__), io.StringIO()
    with contextlib.redirect_stdout(silence), contextlib.redirect_stderr(silence), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sys.__stdout__ = sys.__stderr__ = silence  # type: ignore[assignment]
        try:
            yield
        finally:
            sys.__stdout__, sys.__stderr__ = originals  # type: ignore[misc]


def construct(
    task: TaskSpec, names: Iterable[str], make: Callable[..., Any], arguments: Mapping[str, Any] | None = None
) -> Any:
    """Call `make` with the environment's name and `arguments`, by default the task's.

    Raises `LareError` if the name is not among the package's `names`, or if `make` raises an error.
    """
    name, names = task.name_in_family, list(names)
    message = f"environment {task.environment!r} cannot be made"
    if name not in names:
        hint = did_you_mean(name, names) or f"; it has {', '.join(map(str, names))}"
        raise LareError(f"{message}: {task.family} has no {name!r}{hint}")
    with one_line_errors(message), mujoco_warnings(task.environment), _silence():
        return make(name, **(task.arguments if arguments is None else arguments))


def unusable_error(environment: str, reason: str) -> LareError:
    return LareError(f"environment {environment!r} cannot be used: {reason}")


# Values


def raw_key(key: PRNGKeyArray) -> Array:
    """Return a key as an array of integers, because packages store keys in states, and checkpoints cannot store typed keys."""
    return jax.random.key_data(key)


def flatten_tree(tree: Any) -> Float[Array, " size"]:
    """Return all arrays of a tree in one vector: leaf after leaf, each row by row."""
    leaves = [jnp.ravel(jnp.asarray(leaf)).astype(jnp.float32) for leaf in jax.tree.leaves(tree)]
    return jnp.concatenate(leaves) if leaves else jnp.zeros(0)


def flat_size(tree: Any) -> int:
    """Return the size of `flatten_tree`, from arrays or shapes."""
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(tree))


def cast_like(tree: Any, reference: Any) -> Any:
    """Return a tree with the types of a reference, without weak types, so that a state has the same types at all steps."""
    return jax.tree.map(lambda leaf, other: jnp.asarray(leaf, jnp.asarray(other).dtype), tree, reference)


def find_measures(task: TaskSpec, values: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of the task's measures that are numbers among a package's values."""
    return tuple(name for name in task.info_keys if name in values and math.prod(jnp.shape(values[name])) == 1)


def read_measures(spec: EnvSpec, values: Mapping[str, Any]) -> dict[str, Float[Array, ""]]:
    """Return the measures of a step from a package's values. A measure without a value is 0."""
    return {name: jnp.asarray(values.get(name, 0.0), jnp.float32).reshape(()) for name in spec.measures}


# Actions


def action_fields(space: Any, environment: str) -> dict[str, Any]:
    """Return the fields of `EnvSpec` about actions, from a space of gymnax or a specification of Jumanji.

    The combinations of a multi-discrete action are discrete actions, and its last component changes fastest. Raises `LareError` if
    these are too many, or if actions are neither discrete nor bounded.
    """
    n_values = getattr(space, "n", getattr(space, "num_values", None))
    if n_values is not None:
        shape, sizes = np.shape(n_values), tuple(map(int, np.ravel(n_values)))
        if (size := math.prod(sizes)) > MAX_COMBINATIONS:
            combinations = f"{size} combinations, more than {MAX_COMBINATIONS}"
            raise unusable_error(environment, f"its {len(sizes)} choices at a time have {combinations}")
        return {"discrete": True, "action_size": size, "choice_sizes": sizes if shape else (), "package_shape": shape}
    for low, high in (("low", "high"), ("minimum", "maximum")):
        if hasattr(space, low) and np.issubdtype(space.dtype, np.floating):
            return bounded_action(getattr(space, low), getattr(space, high), space.shape, environment)
    raise unusable_error(environment, f"its actions are {short_repr(space)}: {TRAINABLE_ACTIONS}")


def bounded_action(low: Any, high: Any, shape: Sequence[int], environment: str) -> dict[str, Any]:
    """Return the fields of `EnvSpec` about a continuous action of a single agent. Raises `LareError` if it has no bounds."""
    low, high = (np.broadcast_to(np.asarray(bound, np.float32), shape).reshape(1, -1).copy() for bound in (low, high))
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise unusable_error(environment, "its actions have no bounds")
    return {"discrete": False, "action_size": low.size, "low": low, "high": high, "package_shape": tuple(shape)}


def mask_combinations(mask: Bool[Array, "..."], sizes: tuple[int, ...]) -> Bool[Array, " combinations"]:
    """Return which combinations of a multi-discrete action are available, from a mask of combinations or of each component."""
    if mask.ndim == 1 or mask.shape == sizes:
        return mask.ravel()
    combinations = jnp.ones((), bool)
    for row, size in zip(mask, sizes, strict=True):
        combinations = combinations[..., None] & row[:size]
    return combinations.ravel()


# A single agent


class AgentEnv:
    """A package's environment of one agent as a `JaxEnv`."""

    def __init__(
        self,
        task: TaskSpec,
        env: Any,
        reset: Callable[..., Any],
        step: Callable[..., Any],
        draw: Callable[[list[Any]], Sequence[Any]],
        *,
        max_steps: int,
        **action_spec: Any,
    ):
        """Make the adapter from functions that call the package's environment.

        Args:
            reset: returns a state and the arguments of `agent_timestep` by name, from a raw key.
            step: returns the same, from a state, an action of the package and a raw key.
            draw: returns the pictures of a list of states.
            action_spec: the fields of `EnvSpec` about actions.
        """
        self.env, self._name = env, task.environment
        self._reset, self._step, self._draw = reset, step, draw
        with one_line_errors(f"environment {self._name!r} cannot be used"):
            _, outputs = jax.eval_shape(reset, jnp.zeros(2, jnp.uint32))
        self.spec = EnvSpec(
            teams=(Team("agent", 0, 1),),
            observation_size=flat_size(outputs["observation"]),
            max_steps=max_steps,
            state_size=flat_size(outputs.get("state")),
            masks_actions=outputs.get("available") is not None,
            is_jax=True,
            measures=find_measures(task, outputs.get("measures") or {}),
            **action_spec,
        )

    def reset(self, key: PRNGKeyArray) -> tuple[Any, Timestep]:
        state, outputs = self._reset(raw_key(key))
        return cast_like(state, state), agent_timestep(self.spec, **outputs)

    def step(self, state: Any, action: Float[Array, "1 action"], key: PRNGKeyArray) -> tuple[Any, Timestep]:
        next_state, outputs = self._step(state, to_package_action(action[0], self.spec), raw_key(key))
        return cast_like(next_state, state), agent_timestep(self.spec, **outputs)

    def frames(self, states: Any, credit: Any = None) -> list[np.ndarray]:
        """Return the package's pictures, which do not show credit. Raises `LareError` if it cannot draw them here."""
        return draw_states(self._name, self._draw, states)


def agent_timestep(
    spec: EnvSpec,
    observation: Any,
    *,
    reward: Any = 0.0,
    terminated: Any = False,
    truncated: Any = False,
    available: Bool[Array, " action"] | None = None,
    state: Any = None,
    measures: Mapping[str, Any] | None = None,
) -> Timestep:
    """Return a timestep of a single agent, from trees of arrays as observation and state.

    By default all actions are available. If a mask has none, the first is available.
    """
    if available is None:
        available = jnp.ones(spec.action_size, bool)
    return Timestep(
        observation=flatten_tree(observation)[None],
        state=flatten_tree(state),
        available=with_available_action(available.astype(bool))[None],
        alive=jnp.ones(1, bool),
        reward=jnp.asarray(reward, jnp.float32).reshape(1),
        terminated=jnp.asarray(terminated, bool).reshape(()),
        truncated=jnp.asarray(truncated, bool).reshape(()),
        measures=read_measures(spec, measures or {}),
    )


# Pictures


def draw_states(environment: str, draw: Callable[[list[Any]], Sequence[Any]], states: Any) -> list[np.ndarray]:
    """Return a package's pictures of an episode's states (leading axis: steps). Raises `LareError` if it cannot draw them here."""
    with one_line_errors(f"environment {environment!r} cannot be drawn here", _render_hint), _silence():
        leaves, structure = jax.tree.flatten(jax.device_get(states))
        by_step = [jax.tree.unflatten(structure, step) for step in zip(*leaves, strict=True)]
        return [np.asarray(picture)[..., :3].astype(np.uint8) for picture in draw(by_step)]


def draw_updates(visualizer: Any, n_states: int) -> list[np.ndarray]:
    """Return the pictures that a visualizer draws on its figure when `update` is called with an index. Close the figure."""
    from matplotlib import pyplot

    from lare_rl.envs.canvas import to_pixels

    pictures = []
    try:
        for index in range(n_states):
            visualizer.update(index)
            pictures.append(to_pixels(visualizer.fig))
    finally:
        pyplot.close(visualizer.fig)
    return pictures


def _render_hint(error: BaseException) -> str:
    words = ("GL", "display", "renderer")
    return " (without a screen, set MUJOCO_GL=egl)" if any(word in str(error) for word in words) else ""

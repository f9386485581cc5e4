"""The seed axis: the leading axis of every array of a run, and the devices over which it is spread.

Seeds do not depend on each other. With several devices, each runs the program of its own seeds, and nothing is sent between them.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, TypeVar

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

__all__ = [
    "count_seed_devices",
    "first_device_seeds",
    "jit_over_seeds",
    "seed_sharding",
    "select_seed",
    "shape_over_seeds",
]

AXIS = "seeds"

State = TypeVar("State")


@jax.jit
def select_seed(state: State, seed_index: int | Int[Array, ""] = 0) -> State:
    """Return one seed of a training state."""
    return jax.tree.map(lambda leaf: leaf[seed_index], state)


def count_seed_devices(n_seeds: int) -> int:
    """Return the largest number of this machine's devices that can have equally many seeds each."""
    return max(n for n in range(1, min(n_seeds, jax.local_device_count()) + 1) if n_seeds % n == 0)


def jit_over_seeds(
    function: Callable[..., Any],
    n_devices: int,
    *,
    shared: Sequence[int] = (),
    static: Sequence[str] = (),
    donate: Sequence[int] = (),
) -> jax.stages.Wrapped:
    """Compile a function of arrays with a leading seed axis. Each device runs it for its own seeds.

    Args:
        function: all arrays of its result have a leading seed axis.
        shared: the numbers of the arguments without a seed axis.
        static: the names of the keyword arguments that are compiled into the program.
        donate: the numbers of the arguments whose memory the result may use.
    """

    def run_on_devices(*args: Any, **constants: Any) -> Any:
        specs = tuple(PartitionSpec() if i in shared else PartitionSpec(AXIS) for i in range(len(args)))
        options = {"mesh": _mesh(n_devices), "in_specs": specs, "out_specs": PartitionSpec(AXIS), "check_vma": False}
        return jax.shard_map(partial(function, **constants), **options)(*args)

    mapped = function if n_devices == 1 else run_on_devices
    sharding = seed_sharding(n_devices)
    return jax.jit(mapped, static_argnames=static, donate_argnums=donate, out_shardings=sharding)


def seed_sharding(n_devices: int) -> NamedSharding | None:
    """Return how arrays are spread over devices. None stands for JAX's default."""
    return None if n_devices == 1 else NamedSharding(_mesh(n_devices), PartitionSpec(AXIS))


def shape_over_seeds(shape: State, n_devices: int) -> State:
    """Return shapes that also say how the arrays are spread over devices."""
    sharding = seed_sharding(n_devices)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), shape)


def first_device_seeds(state: State) -> State:
    """Return the seeds on the first device, without a copy."""
    return jax.tree.map(lambda leaf: leaf.addressable_shards[0].data, state)


@cache
def _mesh(n_devices: int) -> Mesh:
    return jax.make_mesh((n_devices,), (AXIS,), (AxisType.Auto,))

"""Runs on a Ray cluster."""

import logging
from collections.abc import Generator, Sequence

from lare_rl.errors import LareError, needs_extra
from lare_rl.sweep.jobs import Job, as_json, train_one


def on_ray(jobs: Sequence[Job], cores: int, address: str) -> Generator[tuple[Job, str | None], None, None]:
    """Train on a Ray cluster, each run on `cores` cores. All machines must share the directory of the runs."""
    try:
        import ray
        from ray.exceptions import RayError
    except ImportError:
        raise needs_extra("a Ray cluster", "ray") from None
    try:
        ray.init(
            None if address == "local" else address,
            log_to_driver=False,
            include_dashboard=False,
            logging_level=logging.ERROR,
        )
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise LareError(f"there is no Ray cluster at {address}: {error}") from error
    try:
        remote = ray.remote(num_cpus=cores, max_calls=1)(train_one)
        waiting = {remote.remote(as_json(job)): job for job in jobs}
        while waiting:
            (ended,), _ = ray.wait(list(waiting), num_returns=1)
            job = waiting.pop(ended)
            try:
                ray.get(ended)
                yield job, None
            except RayError as error:
                yield job, str(error).strip().splitlines()[-1]
    finally:
        ray.shutdown()

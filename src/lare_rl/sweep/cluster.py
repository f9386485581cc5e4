"""Runs on a Ray cluster."""

import logging
from collections.abc import Generator, Sequence

from lare_rl.errors import LareError, missing_extra_error
from lare_rl.sweep.jobs import Job, job_to_json, train_job

__all__ = ["train_on_ray"]


def train_on_ray(jobs: Sequence[Job], cores: int, address: str) -> Generator[tuple[Job, str | None], None, None]:
    """Train jobs on a Ray cluster, each on `cores` cores. Yield each job when it ends, and its error or None.

    All machines must share the directory of the runs.

    Raises:
        LareError: Ray is not installed, or cannot be reached.
    """
    try:
        import ray
        from ray.exceptions import RayError
    except ImportError:
        raise missing_extra_error("a Ray cluster", "ray") from None
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
        remote = ray.remote(num_cpus=cores, max_calls=1)(train_job)
        pending = {remote.remote(job_to_json(job)): job for job in jobs}
        while pending:
            (task,), _ = ray.wait(list(pending), num_returns=1)
            job = pending.pop(task)
            try:
                ray.get(task)
                yield job, None
            except RayError as error:
                yield job, str(error).strip().splitlines()[-1]
    finally:
        ray.shutdown()

"""Training of jobs: on this machine, each in its own process, on its own cores and accelerators, or on a Ray cluster.

A process ends when its parent ends.
"""

import _thread
import contextlib
import json
import logging
import os
import queue
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

from lare_rl.errors import LareError, missing_extra_error
from lare_rl.runs.directory import RunBusyError
from lare_rl.sweep.jobs import Job, describe_job, train_job
from lare_rl.sweep.resources import PREALLOCATE, Resources, Slot, assign_slots
from lare_rl.util.files import make_directory
from lare_rl.util.processes import describe_end, own_session
from lare_rl.util.sanitize import last_line

__all__ = ["train_in_process", "train_in_processes", "train_on_ray"]

LOCK_TIMEOUT_S = 60.0
"""Time to wait for an earlier process that still saves the run."""


def train_in_processes(
    jobs: Sequence[Job], resources: Resources, listener: Callable[[str], None]
) -> Generator[tuple[Job, str | None], None, None]:
    """Train several jobs at a time. Yield each job when it ends, and its error or None.

    Closing the generator stops all jobs, after they have saved a checkpoint.

    Raises `LareError` if there are not enough cores or accelerators.
    """
    free_slots: queue.Queue[Slot] = queue.Queue()
    for slot in assign_slots(resources):
        free_slots.put(slot)
    running: list[subprocess.Popen] = []
    stopped = threading.Event()

    def train(job: Job) -> str | None:
        slot = free_slots.get()
        try:
            listener(f"{job.name} begins" + (f" again at step {job.step()}" if job.started else ""))
            return train_in_process(job, slot, running, stopped)
        except (LareError, OSError) as error:  # only this run fails; the others continue
            return str(error)
        finally:
            free_slots.put(slot)

    pool = ThreadPoolExecutor(resources.processes)
    futures = {pool.submit(train, job): job for job in jobs}
    try:
        yield from ((futures[future], future.result()) for future in as_completed(futures))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        stopped.set()
        for process in running:
            _close_input(process)
        pool.shutdown()


def _close_input(process: subprocess.Popen) -> None:
    """Close the standard input of a process, so that it saves and ends."""
    assert process.stdin is not None
    with contextlib.suppress(OSError):
        process.stdin.close()


def train_in_process(job: Job, slot: Slot, running: list[subprocess.Popen], stopped: threading.Event) -> str | None:
    """Train a job in a new process, which writes its output to RUN.log. Return the error, or None.

    It adds the process to the list `running`. After `stopped` is set, it starts no process.
    """
    if stopped.is_set():
        return "it was not started, because the sweep was stopped"
    make_directory(job.directory.parent)
    log = job.directory.with_name(job.directory.name + ".log")
    if slot.cores:  # of this thread. The process inherits them before NumPy starts threads.
        os.sched_setaffinity(0, slot.cores)
    with log.open("a", encoding="utf-8") as file:
        log_start = file.tell()
        # In its own session, so that Ctrl-C reaches it only once, through this process.
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "lare_rl.sweep.processes"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=file,
            encoding="utf-8",
            errors="replace",
            **own_session(),
            env=os.environ | slot.variables,
        )
        running.append(process)
        if stopped.is_set():  # while it started
            _close_input(process)
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with contextlib.suppress(OSError, ValueError):  # the process has ended, or its input was closed
                process.stdin.write(json.dumps(describe_job(job)) + "\n")
                process.stdin.flush()
            error = process.stdout.read().strip()
            process.wait()
        finally:
            _close_input(process)
            process.stdout.close()
    if process.returncode == 0:
        return None if job.done else f"it ended at step {job.step()} of {job.resolved.steps} ({log})"
    if process.returncode < 0:  # a killed process has sent no error
        error = f"it was ended by {describe_end(process.returncode)}"
    elif not error:  # the error that was sent comes first, because a full disk may cut the log short
        with log.open("rb") as file:
            file.seek(log_start)
            error = last_line(file.read().decode(errors="replace")) or describe_end(process.returncode)
    return f"{error} ({log})"


def train_on_ray(
    jobs: Sequence[Job], resources: Resources, address: str
) -> Generator[tuple[Job, str | None], None, None]:
    """Train jobs on a Ray cluster. Yield each job when it ends, and its error or None.

    All machines must share the directory of the runs.

    Raises `LareError` if Ray is not installed, or cannot be reached.
    """
    try:
        import ray
        from ray.exceptions import RayError
    except ImportError:
        raise missing_extra_error("a Ray cluster", "ray") from None
    try:
        quiet: dict[str, Any] = {"log_to_driver": False, "include_dashboard": False, "logging_level": logging.ERROR}
        ray.init(None if address == "local" else address, **quiet)
    except Exception as error:  # Ray raises `Exception` itself if a node does not start
        raise LareError(f"there is no Ray cluster at {address}: {error}") from error
    try:
        accelerators = resources.accelerators or 0
        variables = {PREALLOCATE: "false"} if 0 < accelerators < 1 else {}
        options: dict[str, Any] = {"num_cpus": resources.cores, "num_gpus": accelerators, "max_calls": 1}
        remote = ray.remote(**options, runtime_env={"env_vars": variables})(_train_when_free)
        pending = {remote.remote(describe_job(job)): job for job in jobs}
        while pending:
            (task,), _ = ray.wait(list(pending), num_returns=1)
            job = pending.pop(task)
            try:
                error = ray.get(task)
            except RayError as failure:  # such as the end of a machine
                error = last_line(str(failure)) or type(failure).__name__
            yield job, error
    finally:
        ray.shutdown()


def main() -> None:
    """Train a run, which the first line of standard input describes. `train_in_process` starts this program.

    The error goes to standard output, all other output to the log. The program ends when its parent ends, which closes standard input.
    """
    # Until training begins, there is nothing to save.
    signal.signal(signal.SIGINT, lambda number, frame: os._exit(130))
    # A path may have bytes that are not UTF-8.
    to_parent = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8", errors="backslashreplace")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    line = sys.stdin.readline()
    if not line:  # it was stopped already
        sys.exit(130)
    threading.Thread(target=_interrupt_at_end_of_input, daemon=True).start()
    if (error := _train_when_free(json.loads(line))) is not None:
        for stream in (sys.stderr, to_parent):  # if one fails (a full disk, a dead parent), the other may work
            with contextlib.suppress(OSError):
                stream.write(f"{error}\n")
                stream.flush()
        sys.exit(2)


def _interrupt_at_end_of_input() -> None:
    """Interrupt the main thread, as Ctrl-C does, when the parent has ended."""
    while os.read(0, 1):  # not through Python's buffer, whose lock would still be held at exit
        pass
    _thread.interrupt_main()


def _train_when_free(job: dict[str, Any]) -> str | None:
    """Train as soon as an earlier process has released the run. Return the error in one line, or None.

    An error that is no `LareError` also writes its traceback to the log.
    """
    deadline = time.monotonic() + LOCK_TIMEOUT_S
    while True:
        try:
            return train_job(job)
        except RunBusyError as error:
            if time.monotonic() > deadline:
                return str(error)
            time.sleep(1)
        except LareError as error:
            return str(error)
        except Exception as error:
            with contextlib.suppress(OSError):  # a full disk
                traceback.print_exc()
            return traceback.format_exception_only(error)[0].splitlines()[0]  # JAX appends notes


if __name__ == "__main__":
    main()

"""Runs on this machine: each in its own process, on its own cores. A process ends when its parent ends."""

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

from lare_rl.errors import LareError
from lare_rl.runs.directory import Busy
from lare_rl.sweep.jobs import Job, as_json, train_one

PATIENCE = 60.0
"""Seconds to wait for another process that was told to stop and still holds the run."""


def in_processes(
    jobs: Sequence[Job], processes: int, cores: int, said: Callable[[str], None]
) -> Generator[tuple[Job, str | None], None, None]:
    """Train, `processes` jobs at a time; yields each job when it ends, and its error or None.

    Closing the generator stops all jobs; those that are running save a checkpoint first.

    Raises:
        LareError: there are not enough cores.
    """
    slots: queue.Queue[list[int]] = queue.Queue()
    for share in shares(processes, cores):
        slots.put(share)
    running = Running()

    def train(job: Job) -> str | None:
        share = slots.get()
        try:
            said(f"{job.name} begins" + (f" again at step {job.step()}" if job.begun else ""))
            return in_a_process(job, share, running)
        except (LareError, OSError) as error:  # only this run fails; the others continue
            return str(error)
        finally:
            slots.put(share)

    pool = ThreadPoolExecutor(processes)
    futures = {pool.submit(train, job): job for job in jobs}
    try:
        yield from ((futures[future], future.result()) for future in as_completed(futures))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        running.stop()
        pool.shutdown()


class Running:
    """The running processes. They can be stopped together; after that no process is started."""

    def __init__(self):
        self.processes: set[subprocess.Popen] = set()
        self.stopped = False
        self.lock = threading.Lock()

    def start(self, command: Sequence[str], **options: Any) -> subprocess.Popen | None:
        """A new process; None after the stop."""
        with self.lock:
            if self.stopped:
                return None
            process = subprocess.Popen(command, **options)
            self.processes.add(process)
            return process

    def ended(self, process: subprocess.Popen) -> None:
        with self.lock:
            self.processes.discard(process)

    def stop(self) -> None:
        """Tell all processes to save and end."""
        with self.lock:
            self.stopped = True
            for process in self.processes:
                process.send_signal(signal.SIGINT)


def shares(processes: int, cores: int) -> list[list[int]]:
    """The cores of each process; an empty list for each if the system cannot tell which cores are usable.

    Raises:
        LareError: there are not enough cores.
    """
    if not hasattr(os, "sched_getaffinity"):
        return [[] for _ in range(processes)]
    usable = sorted(os.sched_getaffinity(0))
    if processes * cores > len(usable):
        raise LareError(
            f"processes = {processes} with cores = {cores} each need {processes * cores} cores, and {len(usable)} are usable here"
        )
    return [usable[place * cores : (place + 1) * cores] for place in range(processes)]


def in_a_process(job: Job, cores: list[int], running: Running) -> str | None:
    """Train one run in its own process; returns the error or None. The output of the process is in RUN.log."""
    job.directory.parent.mkdir(parents=True, exist_ok=True)
    log = job.directory.with_name(job.directory.name + ".log")
    order = json.dumps({"job": as_json(job), "cores": cores})
    with log.open("a", encoding="utf-8") as file:
        said_before = file.tell()
        command = [sys.executable, "-P", "-m", "lare_rl.sweep.processes"]
        # In its own session, so that Ctrl-C reaches it only once, through this process.
        process = running.start(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=file, text=True, start_new_session=True
        )
        if process is None:
            return "it was not started, because all runs were being stopped"
        assert process.stdin is not None
        assert process.stdout is not None
        last_word = ""
        try:
            with contextlib.suppress(BrokenPipeError), process.stdin:  # stdin stays open as long as this process lives
                with contextlib.suppress(BrokenPipeError):
                    process.stdin.write(order + "\n")
                    process.stdin.flush()
                last_word = process.stdout.read().strip()
                process.wait()
        finally:
            process.stdout.close()
            running.ended(process)
    if process.returncode == 0:
        return None if job.done else f"it ended at step {job.step()} of {job.resolved.steps} ({log})"
    if process.returncode < 0:  # a process that was killed, perhaps for its memory, has sent no error
        return f"it was ended by {signal.Signals(-process.returncode).name} ({log})"
    if last_word:  # not read from the log, which a full disk may have cut short
        return f"{last_word} ({log})"
    with log.open("rb") as file:
        file.seek(said_before)
        lines = file.read().decode(errors="replace").splitlines() or [f"exit status {process.returncode}"]
    return f"{lines[-1]} ({log})"


def main() -> None:
    """The program that `in_a_process` starts. It trains one run, which the first line of standard input describes.

    It ends when its parent ends, which it sees by the end of standard input. Errors go to standard output. Everything else
    that is printed goes to the log.
    """
    signal.signal(signal.SIGINT, lambda number, frame: os._exit(130))  # until training begins, there is nothing to save
    answer = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    order = json.loads(sys.stdin.readline())
    threading.Thread(target=end_with_the_input, daemon=True).start()
    if order["cores"]:
        os.sched_setaffinity(0, order["cores"])
    try:
        patiently(order["job"])
    except LareError as error:
        for place in (sys.stderr, answer):  # if one fails (a full disk, a parent that has ended), the other may work
            with contextlib.suppress(OSError):
                place.write(f"{error}\n")
                place.flush()
        sys.exit(2)


def end_with_the_input() -> None:
    """Save and stop, as after Ctrl-C, when the parent has ended."""
    while os.read(0, 1):  # not through Python's buffer, whose lock would still be held at exit
        pass
    os.kill(os.getpid(), signal.SIGINT)


def patiently(order: dict) -> None:
    """Train, as soon as an earlier process has released the run."""
    until = time.monotonic() + PATIENCE
    while True:
        try:
            return train_one(order)
        except Busy:
            if time.monotonic() > until:
                raise
            time.sleep(1)


if __name__ == "__main__":
    main()

"""The time of the decoder's first fit for many agents, and the decoder's accuracy after it.

    python benchmarks/first_fit.py

Each way of fitting starts from the same steps of an untrained policy: the first iteration of IPPO with `lare-rd`, seeds 0 to 2. The
decoders are compared with the true rewards of these steps. Times are processor time for all three seeds, compiling included.
"""

import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np

import lare_rl
from lare_rl.config.resolve import resolve
from lare_rl.runs.directory import create_run
from lare_rl.training import decoder_fits
from lare_rl.training.session import start_session
from lare_rl.training.streams import Stream, stream_keys
from measure import write

LARGE = "held-out, updates as large as later ones"
WAYS = {"PP-15": ("published", "held-out"), "CN-6": ("published", "held-out", LARGE)}


def main() -> None:
    results = {}
    for task, ways in WAYS.items():
        for way in ways:
            results.setdefault(task, {})[way] = measured(task, way)
            write("first_fit", {"seeds": [0, 1, 2], "of each task": results})


def measured(name: str, way: str) -> dict[str, Any]:
    task = lare_rl.load_task(name)
    settings = lare_rl.Settings(method="lare-rd", seeds=3, first_fit="published" if way == "published" else "held-out")
    with tempfile.TemporaryDirectory() as folder:
        run = create_run(Path(folder) / "run", task, resolve(settings, task), [lare_rl.design(task)])
        begun = start_session(run)
        try:
            steps = begun.collector.collect(begun.actor, 0)
            begun.learner, _ = begun.functions.store(begun.learner, steps)
            jax.block_until_ready(begun.learner)
            start = time.process_time()
            with mock.patch.object(decoder_fits, "BATCH_DIVISOR", 1 if way == LARGE else decoder_fits.BATCH_DIVISOR):
                keys = stream_keys(run.seeds, Stream.FIT, 0)
                begun._fit(keys)
                jax.block_until_ready(begun.learner)
            seconds = time.process_time() - start
            accuracy = begun.functions.assess(begun.learner)
        finally:
            begun.close()
    digits = {key: np.round(np.asarray(accuracy[f"credit/{key}"]), 4).tolist() for key in ("correlation", "error")}
    print(name, way, f"{seconds:.0f} s", digits, flush=True)
    return {"processor seconds": round(seconds, 1), **digits}


if __name__ == "__main__":
    main()

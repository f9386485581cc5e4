"""Programs to read: recorded replies, cases that must be accepted, programs written to be varied, and hostile ones.

`varied.json` was written by three authors who had not seen the reader: 223 programs of many styles. All but the hostile
programs are trusted: tests execute them to compare.
"""

import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lare_rl.envs.load import read_task, shipped_tasks
from lare_rl.latent.function import normalise_source
from lare_rl.llm.recording import SHIPPED_RECORDINGS, read_recording
from lare_rl.llm.reply import MalformedReplyError, parse_reply
from lare_rl.phi.graph import Graph
from lare_rl.phi.read import read

HERE = Path(__file__).parent


class Program(NamedTuple):
    name: str
    sizes: tuple[int, int]
    source: str


def _cases(kind: str) -> list[Program]:
    cases = json.loads((HERE / "cases.json").read_text(encoding="utf-8"))[kind]
    return [Program(case["name"], (17, 6), case["code"]) for case in cases]


@cache
def benign_programs() -> list[Program]:
    return _cases("benign")


@cache
def hostile_programs() -> list[Program]:
    attempts = json.loads((HERE / "attempts.json").read_text(encoding="utf-8"))
    return _cases("hostile") + [Program(attempt["name"], (17, 6), attempt["code"]) for attempt in attempts]


@cache
def varied_programs() -> list[Program]:
    programs = json.loads((HERE / "varied.json").read_text(encoding="utf-8"))
    return [Program(program["name"], tuple(program["sizes"]), program["code"]) for program in programs]


@cache
def repaired_programs() -> list[dict[str, str]]:
    """Refused programs of `varied`: the errors, and what a language model made of the program when it saw them."""
    return json.loads((HERE / "mended.json").read_text(encoding="utf-8"))


@cache
def recorded_programs() -> list[Program]:
    """Every function in the shipped recordings."""
    programs = []
    folder = Path(str(SHIPPED_RECORDINGS))
    for path in sorted([*folder.glob("factors/*.json"), *folder.glob("reward/*.json")]):
        task = path.name.partition(".draw")[0]
        if task in shipped_tasks():
            role = read_task(task)
        else:  # a team of a task
            parent, _, team = task.rpartition("-")
            role = next(role for role in read_task(parent).roles if role.team == team)
        for exchange in read_recording(path.read_text(encoding="utf-8"), path.name).exchanges:
            for number, reply in enumerate(exchange.replies):
                try:
                    source = normalise_source(parse_reply(reply).functions)
                except MalformedReplyError:
                    continue
                name = f"{path.parent.name}/{path.stem}/{exchange.stage}{number}"
                programs.append(Program(name, (role.observation_size, role.action_size), source))
    return programs


@cache
def read_program(program: Program) -> Graph:
    """Read a program. Several tests use its graph."""
    return read(program.source, *program.sizes)


def execute_program(source: str, observation: np.ndarray, action: np.ndarray) -> np.ndarray:
    """The factors of a TRUSTED program, by Python and NumPy themselves."""
    namespace: dict = {}
    with np.errstate(all="ignore"):
        exec(compile(source, "phi", "exec"), namespace)
        factors = namespace["evaluation_func"](observation.copy(), action.copy())
    return np.concatenate([np.asarray(factor, np.float64) for factor in factors], axis=1)


def random_inputs(
    sizes: tuple[int, int], rows: int = 48, seed: int = 0, dtype: type = np.float64
) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    observation, action = random.standard_normal((rows, sizes[0])), random.uniform(-1, 1, (rows, sizes[1]))
    return observation.astype(dtype), action.astype(dtype)

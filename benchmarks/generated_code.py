"""Generated code: what its gates refuse, and what its jail costs.

python benchmarks/generated_code.py refused     hostile and benign programs, recorded replies, the jail without the gate
python benchmarks/generated_code.py fuzz        sweeps over all names, splices, mutants and garbage
python benchmarks/generated_code.py cost        verification; phi in the jail compared with in process; its share of training
"""

import ast
import contextlib
import inspect as inspection
import json
import random
import sys
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import lare
from lare.algorithms.settings import TD3Settings
from lare.latent.evaluator import Evaluator
from lare.latent.language import gate
from lare.latent.language.program import Program
from lare.latent.sandbox.jailed import JailedProgram, WorkerFailed
from lare.latent.verification.checks import Trial, examine
from lare.latent.verification.verify import verify
from lare.llm.recording import SHIPPED, read_recording
from lare.llm.reply import parse
from lare.tasks.load import read_task
from lare.training import session as sessions
from measure import advance, interleave, new_session, show, summary, write

CASES = Path(__file__).parents[1] / "tests" / "latent" / "cases.json"
OBSERVATION, ACTION, SEED = 17, 6, 0


def steps(rows: int) -> tuple[np.ndarray, np.ndarray]:
    random_numbers = np.random.default_rng(SEED)
    observation = random_numbers.standard_normal((rows, OBSERVATION), np.float32)
    return observation, random_numbers.uniform(-1, 1, (rows, ACTION)).astype(np.float32)


def judged(source: str) -> str:
    """The stage that refuses a program, or "accepted". An accepted program has made no system call that the jail refuses."""
    with contextlib.ExitStack() as stack:
        try:
            program = stack.enter_context(contextlib.closing(JailedProgram(source, OBSERVATION, ACTION)))
            if program.problems:
                return "static gate"
            if program.failed:
                return "dynamic gate"
            watched = JailedProgram(source, OBSERVATION, ACTION, kill=True, audit=True)
            again = stack.enter_context(contextlib.closing(watched))
            if not all(check.passed for check in examine(Trial(program, again, *steps(256)))):
                return "dynamic gate"
            return "accepted, with audit events" if watched.call(*steps(256)).events else "accepted"
        except WorkerFailed:
            return "worker ended"


def contained(source: str) -> str:
    """The outcome of a program without the gate: it computes, fails, or ends its own process."""
    try:
        with contextlib.closing(JailedProgram(source, OBSERVATION, ACTION, gated=False)) as program:
            outcome = program.failed or program.call(*steps(256))
            return "failed" if outcome.error else "computed"
    except WorkerFailed:
        return "worker ended"


def replies() -> dict[str, dict[str, int]]:
    """By task: how many recorded replies pass every check without a correction, and how many there are."""
    found: dict[str, Counter[str]] = {}
    for kind in sorted(SHIPPED.iterdir(), key=lambda entry: entry.name):
        for entry in sorted(kind.iterdir(), key=lambda entry: entry.name):
            recording = read_recording(entry.read_text(encoding="utf-8"), entry.name)
            task = read_task(recording.task)
            for exchange in recording.exchanges:
                for reply in exchange.replies:
                    row = found.setdefault(f"{recording.task}, {recording.kind}, {exchange.stage}", Counter())
                    row["all"] += 1
                    row["pass"] += verify(parse(reply).functions, task, recording.kind).passed
    return {name: dict(row) for name, row in found.items()}


def timed(cases: list[dict[str, str]], seconds: list[float]) -> Counter[str]:
    """The outcomes of some programs. The time that each takes is added to `seconds`."""
    found: Counter[str] = Counter()
    for case in cases:
        start = time.perf_counter()
        found[judged(case["code"])] += 1
        seconds.append(time.perf_counter() - start)
    return found


def refused() -> None:
    cases = json.loads(CASES.read_text(encoding="utf-8"))
    seconds: list[float] = []
    hostile, benign = timed(cases["hostile"], seconds), timed(cases["benign"], seconds)
    without_gate = Counter(contained(case["code"]) for case in cases["hostile"])
    figures = {
        "hostile programs": dict(hostile),
        "benign programs": dict(benign),
        "seconds to judge one of both": {
            "median": float(np.median(seconds)),
            "95th percentile": float(np.quantile(seconds, 0.95)),
            "worst": max(seconds),
        },
        "hostile programs in the jail, without the gate": dict(without_gate),
        "recorded replies that pass as they came": replies(),
    }
    print(json.dumps(figures, indent=1))
    write("generated_code_refused", figures)


# --- fuzz ------------------------------------------------------------------------------------------------------------

HOSTILE = """
__import__('os') open('/etc/passwd') eval('1') exec('1') globals() getattr(np,'load') type(observation) np.load('x')
np.__dict__ len.__self__ observation.ctypes observation.base observation.tofile('x') np.random.rand() (lambda:0).__globals__
f'{observation.__class__}' '{0.__class__}'.format(1) [].__class__ np.f2py np.ndarray((3,)) np.empty(3) observation.view('O')
np.array([1],'O') observation.astype('O') (np:=1) np.frompyfunc(len,1,1) observation.flags np.save('x',1) print(1) vars()
np.add.at(observation,0,1) np.add(observation,1,observation) np.fromfile('x') np.linalg np math __builtins__ breakpoint()
(yield) (await x) np.apply_along_axis(len,1,observation) np.errstate(call=print) float('nan') id(observation) hash('x')
""".split()


def names() -> Iterator[str]:
    """Expressions with every name in NumPy, and with every attribute of every type that can be reached."""
    for name in dir(np):
        yield f"np.{name}(observation)"
        yield f"np.{name}"
        for inner in dir(getattr(np, name, None)) if inspection.ismodule(getattr(np, name, None)) else ():
            yield f"np.{name}.{inner}(observation)"
    reachable: list[Any] = [
        np.zeros(1),
        np.float32(1),
        np.dtype("f4"),
        np.finfo("f4"),
        [],
        {},
        (),
        1,
        1.0,
        True,
        "",
        None,
    ]
    reachable += [len, names, range(1), slice(1), lambda: 0, np.sin, Ellipsis, type, object, (n for n in [1])]
    for name in sorted({name for value in reachable for name in dir(value)}):
        yield f"observation.{name}"
        yield f"observation.{name}()"


def in_function(expression: str) -> str:
    return f"import numpy as np\ndef evaluation_func(observation, action):\n    x = {expression}\n    return [observation[:, :1]]"


def spliced(source: str, choice: random.Random) -> str:
    """A program in which a hostile expression replaces one of its own."""
    tree = ast.parse(source)
    places = [node for node in ast.walk(tree) if isinstance(node, ast.expr) and hasattr(node, "lineno")]
    place = choice.choice(places)
    lines = source.split("\n")
    if place.lineno != place.end_lineno:
        return source + "\n" + choice.choice(HOSTILE)
    line = lines[place.lineno - 1].encode()
    new = line[: place.col_offset] + choice.choice(HOSTILE).encode() + line[place.end_col_offset :]
    lines[place.lineno - 1] = new.decode(errors="replace")
    return "\n".join(lines)


def crossed(sources: list[str], choice: random.Random) -> str:
    """The first lines of one program and the last lines of another."""
    one, other = (choice.choice(sources).split("\n") for _ in range(2))
    return "\n".join(one[: choice.randrange(len(one) + 1)] + other[choice.randrange(len(other) + 1) :])


def garbage(choice: random.Random) -> str:
    letters = "abxnp.()[]{}:,=+-*/%@&|^~<>!'\"\\\n \t0123456789_#éｆ\0\ud800lambda def return import "
    return "".join(choice.choice(letters) for _ in range(choice.randrange(400)))


def frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


FORBIDDEN = ("open", "import", "exec", "compile", "os.", "subprocess", "socket", "ctypes", "object.__getattr__")


def fuzz(budget: int = 20_000) -> None:
    cases = json.loads(CASES.read_text(encoding="utf-8"))
    benign, hostile = ([case["code"] for case in cases[kind]] for kind in ("benign", "hostile"))
    choice = random.Random(SEED)
    sweep = [in_function(expression) for expression in names()]
    allowed = Counter("accepted" if not gate.inspect(source) else "refused" for source in sweep)
    families = {
        "splices of hostile expressions": [spliced(choice.choice(benign), choice) for _ in range(budget)],
        "mutants crossed from benign and hostile programs": [crossed(benign + hostile, choice) for _ in range(budget)],
        "garbage": [garbage(choice) for _ in range(budget)],
    }
    events: Counter[str] = Counter()
    watching = False

    def watch(event: str, _: Any) -> None:
        if watching and event.startswith(FORBIDDEN):
            events[event] += 1

    sys.addaudithook(watch)
    figures: dict[str, Any] = {"sweep over names": {"programs": len(sweep), **allowed}, "seed": SEED}
    for family, sources in families.items():
        found: Counter[str] = Counter()
        for source in sources:
            outcome = "refused" if gate.inspect(source) else None
            if outcome is None:
                program = Program(source)
                watching = True
                try:
                    with np.errstate(all="ignore"):
                        program(*(frozen(array) for array in steps(8)))
                    outcome = "accepted"
                except Exception as error:
                    outcome = f"accepted, then {type(error).__name__}"
                watching = False
            found[outcome] += 1
        figures[family] = {"programs": len(sources), **found}
    figures["audit events of accepted programs"] = dict(events)
    print(json.dumps(figures, indent=1))
    write("generated_code_fuzz", figures)


# --- cost ------------------------------------------------------------------------------------------------------------


def cost(rounds: int = 7) -> None:
    task = lare.load_task("HalfCheetah-v4")
    phi = lare.design(task, candidates=1)
    seconds = []
    for _ in range(rounds):
        start = time.perf_counter()
        assert verify(phi.source, task).passed
        seconds.append(time.perf_counter() - start)
    jailed, plain = Evaluator(phi.source, phi.names, OBSERVATION, ACTION), Program(phi.source)
    tables = {}
    for rows, calls in ((1, 500), (256, 500), (4096, 100), (100_000, 10)):
        batch = steps(rows)

        def in_process(batch: Any, calls: int) -> None:
            for _ in range(calls):
                with np.errstate(all="ignore"):
                    np.concatenate(plain(*batch), axis=1).astype(np.float32)

        def in_jail(batch: Any, calls: int) -> None:
            for _ in range(calls):
                jailed(*batch)

        contenders = {"in process": partial(in_process, batch, calls), "in the jail": partial(in_jail, batch, calls)}
        tables[f"{rows:,} rows"] = summary(interleave(contenders, rounds), calls, "in process")
        show(f"phi, {rows:,} rows", tables[f"{rows:,} rows"], "in process")
    figures = {"verification, seconds": sorted(round(one, 3) for one in seconds), "phi": tables, "share": share(phi)}
    print(json.dumps({name: figures[name] for name in ("verification, seconds", "share")}))
    write("generated_code_cost", figures)


def share(phi: Any, steps_of_run: int = 3000) -> dict[str, float]:
    """The share of a training run's time that phi takes."""
    import tempfile

    settings = lare.Settings(method="lare-rrdu", seed=SEED, td3=TD3Settings(warmup=1000))
    with tempfile.TemporaryDirectory() as place:
        session = new_session(Path(place) / "run", "HalfCheetah-v4", settings)
        advance(session, 1000)
        spent = 0.0
        annotate = sessions.annotate

        def timed(*given: Any) -> Any:
            nonlocal spent
            start = time.perf_counter()
            result = annotate(*given)
            spent += time.perf_counter() - start
            return result

        sessions.annotate = timed
        start = time.perf_counter()
        advance(session, steps_of_run)
        whole = time.perf_counter() - start
        sessions.annotate = annotate
        session.close()
    return {"steps": steps_of_run, "seconds": whole, "seconds in phi": spent, "share": spent / whole}


COMMANDS = {"refused": refused, "fuzz": fuzz, "cost": cost}

if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1] not in COMMANDS:
        sys.exit(__doc__)
    COMMANDS[sys.argv[1]]()

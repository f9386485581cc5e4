"""Generated code: what can be read, what reading costs, and what the graphs cost.

python benchmarks/generated_code.py programs    recorded, varied and hostile programs, and attacks: accepted, refused, time, memory
python benchmarks/generated_code.py fuzz        sweeps over all names, splices, mutants and garbage
python benchmarks/generated_code.py cost        graphs in NumPy and in JAX, compile time, share of a training iteration
"""

import ast
import inspect
import json
import random
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lare_rl
from lare_rl.algorithms.td3 import TD3Settings
from lare_rl.latent.factors import compute_batch
from lare_rl.latent.verify import verify
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.graph import Graph
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.read import read
from lare_rl.training.compiled import compile_functions
from lare_rl.training.decoder_inputs import is_compilable
from measure import interleave, new_session, write

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers.attacks import ATTACKS
from helpers.phi_programs import Program, benign_programs, hostile_programs, recorded_programs, varied_programs

SEED = 0


def quantiles(values: Iterable[float]) -> dict[str, float]:
    array = np.array(list(values), float)
    return {
        "median": round(float(np.median(array)), 4),
        "95th percentile": round(float(np.quantile(array, 0.95)), 4),
        "worst": round(float(array.max()), 4),
    }


def corpora() -> dict[str, list[Program]]:
    """All programs, each once."""
    distinct = {(p.source, p.sizes): p for p in recorded_programs()}
    return {
        "recorded replies": list(distinct.values()),
        "benign": benign_programs(),
        "varied": varied_programs(),
        "hostile": hostile_programs(),
    }


def read_graphs(programs: Iterable[Program]) -> list[Graph]:
    graphs = []
    for program in programs:
        try:
            graphs.append(read(program.source, *program.sizes))
        except RefusedError:
            continue
    return graphs


# --- programs -----------------------------------------------------------------------------------------------------------


def peak_memory() -> float:
    """The largest memory of this process so far, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def read_all(programs: Iterable[Program]) -> dict[str, Any]:
    outcomes, seconds, sizes = Counter(), [], []
    before = peak_memory()
    for program in programs:
        start = time.perf_counter()
        try:
            sizes.append(read(program.source, *program.sizes))
            outcomes["accepted"] += 1
        except RefusedError as refusal:
            outcomes[f"refused, {refusal.code}"] += 1
        seconds.append(1000 * (time.perf_counter() - start))
    row: dict[str, Any] = {"programs": len(seconds), **outcomes, "ms to read": quantiles(seconds)}
    row["MB added to the process"] = round(peak_memory() - before, 1)
    if sizes:
        row["operations"] = quantiles(len(graph.operations) for graph in sizes)
        row["longest chain"] = quantiles(graph.depth for graph in sizes)
        row["numbers for each row"] = quantiles(graph.size for graph in sizes)
    return row


def programs() -> None:
    attacks = [Program(name, (17, 6), source) for name, source in ATTACKS.items()]
    read_all(benign_programs())  # what is loaded at first use
    figures = {name: read_all(corpus) for name, corpus in (*corpora().items(), ("attacks", attacks))}
    task = lare_rl.load_task("HalfCheetah-v4")
    phi = lare_rl.design(task, candidates=1)
    verify(phi.source, task)
    seconds = []
    for _ in range(20):
        start = time.perf_counter()
        assert verify(phi.source, task).passed
        seconds.append(1000 * (time.perf_counter() - start))
    figures["ms to verify a function of HalfCheetah-v4"] = quantiles(seconds)
    print(json.dumps(figures, indent=1))
    write("generated_code_programs", figures)


# --- fuzz ---------------------------------------------------------------------------------------------------------------

HOSTILE = """
__import__('os') open('/etc/passwd') eval('1') exec('1') globals() getattr(np,'load') type(observation) np.load('x')
np.__dict__ len.__self__ observation.ctypes observation.base observation.tofile('x') np.random.rand() (lambda:0).__globals__
f'{observation.__class__}' '{0.__class__}'.format(1) [].__class__ np.f2py np.ndarray((3,)) np.empty(3) observation.view('O')
np.array([1],'O') observation.astype('O') (np:=1) np.frompyfunc(len,1,1) observation.flags np.save('x',1) print(1) vars()
np.add.at(observation,0,1) np.add(observation,1,observation) np.fromfile('x') np.linalg np math __builtins__ breakpoint()
(yield) (await x) np.apply_along_axis(len,1,observation) np.errstate(call=print) float('nan') id(observation) hash('x')
""".split()
FORBIDDEN = tuple("open import exec os. subprocess socket ctypes object.__getattr__ object.__setattr__".split())
"""Audit events that reading must not cause. `ast.parse` causes "compile"."""


def sweep() -> Iterator[str]:
    """Expressions with every name in NumPy, and with every attribute of every type that a value could have."""
    for name in dir(np):
        yield f"np.{name}(observation)"
        yield f"np.{name}"
        for inner in dir(getattr(np, name, None)) if inspect.ismodule(getattr(np, name, None)) else ():
            yield f"np.{name}.{inner}(observation)"
    values: list[Any] = [
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
        1j,
    ]
    values += [len, sweep, range(1), slice(1), lambda: 0, np.sin, Ellipsis, type, object, (n for n in [1])]
    for name in sorted({name for value in values for name in dir(value)}):
        for owner in "observation [1] {} 'a' 1.0 len (lambda:0) np np.sin (1,2) {1} slice(1)".split():
            yield f"{owner}.{name}"
            yield f"{owner}.{name}()"


def in_function(expression: str) -> str:
    body = f"    x = {expression}\n    return [observation[:, :1]]"
    return f"import numpy as np\ndef evaluation_func(observation, action):\n{body}"


def spliced(source: str, choice: random.Random) -> str:
    """A program in which a hostile expression replaces one of its own."""
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.expr)]
    node = choice.choice(nodes)
    lines = source.split("\n")
    if node.lineno != node.end_lineno:
        return source + "\n" + choice.choice(HOSTILE)
    line = lines[node.lineno - 1].encode()
    new = line[: node.col_offset] + choice.choice(HOSTILE).encode() + line[node.end_col_offset :]
    lines[node.lineno - 1] = new.decode(errors="replace")
    return "\n".join(lines)


def crossed(sources: list[str], choice: random.Random) -> str:
    """The first lines of one program and the last lines of another."""
    first, second = (choice.choice(sources).split("\n") for _ in range(2))
    return "\n".join(first[: choice.randrange(len(first) + 1)] + second[choice.randrange(len(second) + 1) :])


def garbage(choice: random.Random) -> str:
    letters = "abxnp.()[]{}:,=+-*/%@&|^~<>!'\"\\\n \t0123456789_#éｆ\0\ud800lambda def return import "
    return "".join(choice.choice(letters) for _ in range(choice.randrange(400)))


def fuzz(budget: int = 3_000) -> None:
    choice = random.Random(SEED)
    trusted = [program.source for program in (*benign_programs(), *varied_programs())]
    mixed = trusted + [program.source for program in hostile_programs()]
    families: dict[str, Iterable[str]] = {
        "names and attributes": [in_function(expression) for expression in sweep()],
        "splices of hostile expressions": [spliced(choice.choice(trusted), choice) for _ in range(budget)],
        "programs crossed with others": [crossed(mixed, choice) for _ in range(budget)],
        "garbage": [garbage(choice) for _ in range(budget)],
    }
    events: Counter[str] = Counter()
    watching = False

    def watch(event: str, _: Any) -> None:
        if watching and event.startswith(FORBIDDEN):
            events[event] += 1

    read_graphs(varied_programs())  # what is loaded at first use
    sys.addaudithook(watch)
    figures: dict[str, Any] = {"seed": SEED}
    steps = [np.random.default_rng(SEED).standard_normal((6, size)).astype(np.float32) for size in (64, 64)]
    for family, sources in families.items():
        outcomes, seconds = Counter(), []
        for source in sources:
            watching, start = True, time.perf_counter()
            try:
                graph = read(source, 64, 64)
            except RefusedError:
                graph = None
            watching = False
            seconds.append(1000 * (time.perf_counter() - start))
            outcomes["accepted" if graph else "refused"] += 1
            if graph is not None:
                alone = compute_batch(graph, *(array[2:3] for array in steps))[0]
                same = np.allclose(compute_batch(graph, *steps)[2], alone, rtol=1e-4, atol=1e-4, equal_nan=True)
                outcomes["accepted, but rows differ"] += not same
        figures[family] = {"programs": len(seconds), **outcomes, "ms to read": quantiles(seconds)}
    figures["audit events while reading"] = dict(events)
    print(json.dumps(figures, indent=1))
    write("generated_code_fuzz", figures)


# --- cost ---------------------------------------------------------------------------------------------------------------


def best_ms(work: Callable[[], Any], rounds: int = 7) -> float:
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1000 * min(times)


def graph_costs(program: Program) -> dict[str, float]:
    """Milliseconds to compute the graph of a program, and to compile it."""
    graph = read(program.source, *program.sizes)
    random_numbers = np.random.default_rng(SEED)
    inputs = {
        name: random_numbers.standard_normal((1000, size)).astype(np.float32)
        for name, size in zip(("observation", "action"), program.sizes, strict=True)
    }
    row = {name: array[:1] for name, array in inputs.items()}
    costs = {
        "NumPy, 1 row": best_ms(lambda: evaluate(graph, row)),
        "NumPy, 1,000 rows": best_ms(lambda: evaluate(graph, inputs)),
    }
    if is_compilable(graph):
        start = time.perf_counter()
        lowered = jax.jit(lambda inputs: evaluate(graph, inputs, jnp)["factors"]).lower(inputs)
        traced = time.perf_counter()
        function = lowered.compile()
        costs |= {"JAX, to trace": 1000 * (traced - start), "JAX, to compile": 1000 * (time.perf_counter() - traced)}
        costs["JAX, 1,000 rows"] = best_ms(lambda: jax.block_until_ready(function(inputs)))
    return costs


def iteration_costs(task: str, settings: lare_rl.Settings, rounds: int = 5) -> dict[str, float]:
    """Milliseconds of an iteration, of storing its steps, and of storing them without phi."""
    with tempfile.TemporaryDirectory() as folder:
        session = new_session(Path(folder) / "run", task, settings)

        def iterate() -> None:
            session.advance(session.step + session.settings.iteration_steps)

        for _ in range(3):
            iterate()
        steps = session.collector.collect(session.actor, session.step)
        plain = compile_functions(session.config).store
        copies = {name: jax.tree.map(jnp.copy, session.learner) for name in ("with phi", "without phi")}

        def store(name: str, function: Callable[..., Any]) -> None:
            copies[name] = jax.block_until_ready(function(copies[name], steps))[0]

        work = {
            "with phi": lambda: store("with phi", session.functions.store),
            "without phi": lambda: store("without phi", plain),
            "iteration": lambda: (iterate(), jax.block_until_ready(session.learner)),
        }
        seconds = interleave(work, rounds)
        session.close()
    ms = {name: 1000 * float(np.median(values)) for name, values in seconds.items()}
    phi = max(ms["with phi"] - ms["without phi"], 0.0)
    return {**ms, "phi": phi, "share of phi": phi / ms["iteration"]}


ITERATIONS = {
    "HalfCheetah-v4": lare_rl.Settings(method="lare-bayes", algorithm="td3", td3=TD3Settings(warmup=100)),
    "CN-6": lare_rl.Settings(method="lare-bayes", algorithm="ippo"),
    "CN-30": lare_rl.Settings(method="lare-bayes", algorithm="ippo"),
    "SMAX-2s3z": lare_rl.Settings(method="lare-rd", algorithm="qmix"),
}


def cost() -> None:
    """Every fourth program, and an iteration of four tasks."""
    rows: dict[str, list[float]] = {}
    distinct = [program for name, corpus in corpora().items() if name != "hostile" for program in corpus][::4]
    for program in distinct:
        try:
            costs = graph_costs(program)
        except RefusedError:
            continue
        for name, value in costs.items():
            rows.setdefault(name, []).append(value)
    figures: dict[str, Any] = {f"ms, {name}": quantiles(values) for name, values in rows.items()}
    for task, settings in ITERATIONS.items():
        figures[f"ms of an iteration of {task}, one seed"] = {
            key: round(value, 4) for key, value in iteration_costs(task, settings).items()
        }
        print(task, figures[f"ms of an iteration of {task}, one seed"], flush=True)
    print(json.dumps(figures, indent=1))
    write("generated_code_cost", figures)


if __name__ == "__main__":
    {"programs": programs, "fuzz": fuzz, "cost": cost}[sys.argv[1]]()

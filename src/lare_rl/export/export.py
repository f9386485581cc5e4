"""`lare-rl export`: what a run has learned, for programs that have neither LaRe nor JAX.

DIRECTORY/
  export.json              task, seed, step; inputs, outputs and operations of each function
  policy.npz, .onnx        observation -> action
  reward.npz, .onnx        steps -> r_hat, phi and decoder as one function; one reward_TEAM each if several teams learn
  latent_function.py       the source of phi, for readers
  exported.py, evaluate.py NumPy code that computes the .npz files
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from lare_rl.errors import LareError
from lare_rl.evaluation.policy import choices
from lare_rl.export import exported
from lare_rl.export.policy_graph import policy_graph
from lare_rl.export.reward_graph import reward_graph, unexported
from lare_rl.phi import evaluate
from lare_rl.phi.graph import Gather, Graph, Node
from lare_rl.phi.onnx import BATCH, is_installed, onnx_model
from lare_rl.runs.directory import Run, as_run, function_file
from lare_rl.training.compiled import compiled
from lare_rl.training.seed_axis import of_seed
from lare_rl.training.session import load_actor, load_learner
from lare_rl.util.files import write_atomically
from lare_rl.util.provenance import source

TEXT = "export.json"
DTYPES = {"float": "float32", "int": "int64", "bool": "bool"}
"""The types of the inputs and outputs of each kind."""


class Exported(NamedTuple):
    """What was written."""

    directory: Path
    functions: tuple[str, ...]
    """`policy`, and `reward` or one for each team."""
    left_out: str | None
    """Why there is no reward function; None if there is one."""
    onnx: bool
    """Whether there are ONNX files: the package `onnx` is installed."""


def export(run: Run | str | Path, out: str | Path, seed: int | None = None, best: bool = False) -> Exported:
    """Write the policy and the proxy rewards of a seed to a directory that must not exist.

    A policy returns its most likely action; if evaluations sample choices, it returns their logits too. Rewards are those
    of the last checkpoint's decoder, in the unit of the true rewards.

    Args:
        run: the run, or its directory.
        out: the directory.
        seed: one of the run's seeds; the default is the first.
        best: write the policy of the seed's best evaluation, instead of the last policy. Proxy rewards are always the last ones.

    Raises:
        LareError: there is no such seed, no checkpoint, or the directory exists or cannot be written.
    """
    out, run = Path(out), as_run(run)
    place = run.place_of(seed)
    if out.exists():
        raise LareError(f"{out} exists, and is not overwritten; choose another directory")
    config, learner, host, _ = load_learner(run)
    if best:
        _, actors, since = load_actor(run, of_best=True)
        step = int(since[place])
    else:
        actors, step = compiled(config).actor(learner, host["step"]), host["step"]
    actor = jax.tree.map(lambda leaf: leaf[place], actors)
    start = choices(run).start if config.env.discrete and config.env.agents == 1 else 0
    graphs = {"policy": policy_graph(actor, config, start)}
    credit = of_seed(learner.credit, place)
    left_out = unexported(config, credit[0].decoder if credit else None)
    files: dict[str, str] = {}
    for team, role in enumerate(run.config.task.roles if left_out is None else ()):
        name = "reward" if role is run.config.task else f"reward_{role.team}"
        phi, decoder = run.functions[team] if run.functions else None, credit[team] if credit else None
        files[name] = function_file(run.config.task, role)
        graphs[name] = reward_graph(decoder, config, team, None if phi is None else phi.graph)
    try:
        out.mkdir(parents=True)
    except FileExistsError:
        raise LareError(f"{out} exists, and is not overwritten; choose another directory") from None
    except OSError as error:
        raise LareError(f"{out} cannot be written: {error.strerror}") from error
    text: dict[str, Any] = {
        "lare": source(),
        "task": run.config.task.name,
        "method": run.config.settings.method,
        "algorithm": run.config.settings.algorithm,
        "seed": run.seeds[place],
        "step": step,
    }
    for name, graph in graphs.items():
        text[name] = described(graph)
        if name in files and config.env.discrete and not config.of_state:
            text[name]["choices"] = {"first": start, "count": config.env.action_size}
        write_arrays(out / f"{name}.npz", graph)
        if is_installed():
            model = onnx_model(graph, name).SerializeToString()
            write_atomically(out / f"{name}.onnx", lambda file, model=model: file.write(model))
    for file, function in zip(files.values(), run.functions, strict=False):
        function.save(out / file)
    whole = json.dumps(text, indent=1).encode()
    write_atomically(out / TEXT, lambda file: file.write(whole))
    for module in (exported, evaluate):
        code = Path(str(module.__file__)).read_bytes()
        write_atomically(out / Path(str(module.__file__)).name, lambda file, code=code: file.write(code))
    return Exported(out, tuple(graphs), left_out, is_installed())


def described(graph: Graph) -> dict[str, Any]:
    """A graph as JSON, without its constants and positions."""

    def arrays(nodes: dict[str, Node]) -> dict[str, Any]:
        return {name: {"shape": [BATCH, *node.shape], "type": DTYPES[node.kind]} for name, node in nodes.items()}

    outputs = {name: graph.nodes[i] for name, i in graph.outputs.items()}
    return {
        "inputs": arrays(graph.inputs),
        "outputs": arrays(outputs),
        "output_nodes": graph.outputs,
        "nodes": [[node.op, node.inputs, node.shape, node.kind, _option(node.option)] for node in graph.nodes],
    }


def _option(option: Any) -> Any:
    """An option as JSON; None for arrays, which are in the .npz file."""
    if isinstance(option, Gather):
        return option.slices and [[s.start, s.stop, s.step] for s in option.slices]
    return None if isinstance(option, np.ndarray) else option


def write_arrays(path: Path, graph: Graph) -> None:
    """Write the constants of a graph, and the positions that are no slices, by the indices of their nodes."""
    arrays = {}
    for i, node in enumerate(graph.nodes):
        if node.op == "constant":
            arrays[str(i)] = node.option.astype(np.float32) if node.kind == "float" else node.option
        elif node.op == "gather" and node.option.slices is None:
            arrays[str(i)] = node.option.positions
    write_atomically(path, lambda file: np.savez(file, allow_pickle=False, **arrays))

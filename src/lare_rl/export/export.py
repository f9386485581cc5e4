"""`lare-rl export`: what a run has learned, for programs that have neither LaRe nor JAX.

DIRECTORY/
  export.json                task, method, algorithm, seed, the policy's step; inputs, outputs and operations of each function
  policy.npz, .onnx          observation -> action (other inputs and outputs: `policy_graph.py`); .onnx if onnx is installed
  reward.npz, .onnx          steps -> r_hat (phi and decoder as one function); one reward_TEAM each if several teams learn
  latent_function.py, .json  the source of phi, and how it was made; one latent_function_TEAM each if several teams learn
  exported.py, evaluate.py   NumPy code that evaluates the functions in export.json and the .npz files

A method whose rewards cannot be exported (`ExportResult.no_reward_reason`) has no files of rewards.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lare_rl.errors import LareError
from lare_rl.export import exported
from lare_rl.export.policy_graph import policy_graph
from lare_rl.export.reward_graph import missing_reward_reason, reward_graph
from lare_rl.phi import evaluate
from lare_rl.phi.graph import Gather, Graph, Node
from lare_rl.phi.onnx import BATCH, DTYPES, is_onnx_installed, onnx_model
from lare_rl.runs.directory import Run, as_run, function_filename, function_suffix
from lare_rl.training.saved_state import load_actor, load_learner
from lare_rl.training.seed_axis import select_seed
from lare_rl.util.files import new_directory, replace_npz, write_bytes
from lare_rl.util.provenance import code_version

__all__ = ["ExportResult", "export_run"]


class ExportResult(NamedTuple):
    """What was written."""

    directory: Path
    functions: tuple[str, ...]
    """`policy`, and `reward` or one for each team."""
    no_reward_reason: str | None
    """Why there is no reward function, or None."""
    onnx: bool
    """Whether ONNX files were written, which needs the package `onnx`."""


def export_run(run: Run | str | Path, out: str | Path, seed: int | None = None, best: bool = False) -> ExportResult:
    """Write the policy and the reward functions of a seed to a directory.

    The policy acts without noise: of choices, it returns the most likely one. Algorithms with a function `logits` (PPO, IPPO) also return
    the logits of choices. Rewards are those of the last checkpoint's decoder; their unit: `reward_graph.py`.

    Args:
        run: the run, or its directory.
        out: the directory to write, which must not exist.
        seed: one of the run's seeds; the default is the first.
        best: write the policy of the seed's best evaluation, instead of the last policy.

    Raises:
        LareError: there is no such seed, no checkpoint or no best policy, the policy has an operation that cannot be exported, or the
            directory exists or cannot be written.
    """
    out, run = Path(out), as_run(run)
    seed_index, task, settings = run.seed_index(seed), run.config.task, run.config.settings
    if out.exists():
        raise LareError(f"{out} exists, and is not overwritten; choose another directory")
    state = load_learner(run)
    config, actors, step = state.config, state.actor, state.metadata["step"]
    if best:
        _, actors, best_steps = load_actor(run, best=True)
        step = int(best_steps[seed_index])
    graphs = {"policy": policy_graph(select_seed(actors, seed_index), config)}
    decoders = select_seed(state.learner.decoders, seed_index)
    no_reward_reason = missing_reward_reason(config)
    if no_reward_reason is None:
        for team_index, role in enumerate(task.roles):
            phi = run.functions[team_index] if run.functions else None
            name = "reward" + function_suffix(task, role)
            graphs[name] = reward_graph(decoders[team_index], config, team_index, phi)
    descriptions = {name: _describe_graph(graph) for name, graph in graphs.items()}
    if config.env.discrete and not config.team_level:  # for `exported.reward`, which makes one-hot rows of choices
        choices = {"first": config.env.first_choice, "count": config.env.action_size}
        for name in graphs.keys() - {"policy"}:
            descriptions[name]["choices"] = choices
    # The policy returns the number of a combination of choices: np.unravel_index(number, choice_sizes).
    if config.env.choice_sizes:
        descriptions["policy"]["choice_sizes"] = config.env.choice_sizes
    origin = {"method": settings.method, "algorithm": settings.algorithm, "seed": run.seeds[seed_index], "step": step}
    with new_directory(out) as new:
        _write_files(new, graphs, {"lare": code_version(), "task": task.name, **origin, **descriptions})
        for role, function in zip(task.roles, run.functions, strict=False):  # a method without phi has no functions
            function.save(new / function_filename(task, role))
    return ExportResult(out, tuple(graphs), no_reward_reason, onnx=is_onnx_installed())


def _write_files(out: Path, graphs: dict[str, Graph], description: dict[str, Any]) -> None:
    for name, graph in graphs.items():
        _write_arrays(out / f"{name}.npz", graph)
        if is_onnx_installed():
            write_bytes(out / f"{name}.onnx", onnx_model(graph, name).SerializeToString())
    write_bytes(out / "export.json", json.dumps(description, indent=1).encode())
    for module in (exported, evaluate):
        source = Path(str(module.__file__))
        write_bytes(out / source.name, source.read_bytes())


def _describe_graph(graph: Graph) -> dict[str, Any]:
    """Return a description of a graph for JSON, without the arrays that `_write_arrays` writes."""

    def describe_arrays(nodes: dict[str, Node]) -> dict[str, Any]:
        return {
            name: {"shape": [BATCH, *node.shape], "type": np.dtype(DTYPES[node.kind]).name}
            for name, node in nodes.items()
        }

    return {
        "inputs": describe_arrays(graph.inputs),
        "outputs": describe_arrays({name: graph.nodes[i] for name, i in graph.outputs.items()}),
        "output_nodes": graph.outputs,
        "nodes": [[node.op, node.inputs, node.shape, node.kind, _option_json(node.option)] for node in graph.nodes],
    }


def _option_json(option: Any) -> Any:
    """Return an option as JSON. Arrays are None, because they are in the .npz file."""
    if isinstance(option, Gather):
        return None if option.slices is None else [[s.start, s.stop, s.step] for s in option.slices]
    return None if isinstance(option, np.ndarray) else option


def _write_arrays(path: Path, graph: Graph) -> None:
    """Write the constants of a graph, and the positions of each gather without slices. An array's name is the index of its node."""
    arrays = {}
    for i, node in enumerate(graph.nodes):
        if node.op == "constant":
            with np.errstate(over="ignore"):  # a large constant becomes inf, as in float32 arithmetic
                arrays[str(i)] = node.option.astype(np.float32) if node.kind == "float" else node.option
        elif node.op == "gather" and node.option.slices is None:
            arrays[str(i)] = node.option.positions
    replace_npz(path, arrays)

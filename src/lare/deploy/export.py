"""`lare export`: what a run has learned, for programs that have neither LaRe nor JAX.

DIRECTORY/
  export.json              task, seed, step; inputs, outputs and operations of each function
  policy.npz, .onnx        observation -> action
  reward.npz, .onnx        steps -> r_hat, phi and decoder as one function; one reward_TEAM each if several teams learn
  latent_function.py       the source of phi
  exported.py              NumPy code that runs the .npz files
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from lare.deploy import exported, onnx
from lare.deploy.graph import BATCH, Graph
from lare.deploy.policy import policy
from lare.deploy.reward import reward, unexported
from lare.deploy.rows import Untranslatable
from lare.errors import LareError
from lare.experiments.policy import choices
from lare.files import write_atomically
from lare.run.directory import Run, as_run, function_file
from lare.source import source
from lare.tasks.spec import judged_states
from lare.training.compiled import compiled
from lare.training.seeds import of_seed
from lare.training.session import load_actor, load_learner

TEXT, LOADER = "export.json", "exported.py"


class Exported(NamedTuple):
    """What was written."""

    directory: Path
    functions: tuple[str, ...]
    """`policy`, and `reward` or one for each team."""
    left_out: str | None
    """Why there is no reward function; None if there is one."""
    apart: dict[str, str]
    """The names of reward functions that take the factors of phi as an input, and the part of phi that cannot be translated."""
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
    graphs = {"policy": policy(actor, config, start)}
    credit = of_seed(learner.credit, place)
    left_out = unexported(config, credit[0].decoder if credit else None)
    files: dict[str, str] = {}
    apart: dict[str, str] = {}
    for team, role in enumerate(run.config.task.roles if left_out is None else ()):
        name = "reward" if role is run.config.task else f"reward_{role.team}"
        phi, decoder = run.functions[team] if run.functions else None, credit[team] if credit else None
        files[name] = function_file(run.config.task, role)
        try:
            graphs[name] = reward(decoder, config, team, phi)
        except Untranslatable as error:
            apart[name] = str(error)
            graphs[name] = reward(decoder, config, team)
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
        if name in apart:
            text[name] |= {"phi": files[name], "judges": judged_states(run.judges, "before", "after")}
        write_arrays(out / f"{name}.npz", graph)
        if onnx.is_installed():
            onnx.write(graph, out / f"{name}.onnx", name)
    for file, function in zip(files.values(), run.functions, strict=False):
        function.save(out / file)
    whole = json.dumps(text, indent=1).encode()
    write_atomically(out / TEXT, lambda file: file.write(whole))
    loader = Path(exported.__file__).read_bytes()
    write_atomically(out / LOADER, lambda file: file.write(loader))
    return Exported(out, tuple(graphs), left_out, apart, onnx.is_installed())


def described(graph: Graph) -> dict[str, Any]:
    """A graph as JSON, without its constants."""
    sides = {
        side: {name: {"shape": [BATCH, *shape], "type": graph.kinds[name]} for name, shape in shapes.items()}
        for side, shapes in (("inputs", graph.inputs), ("outputs", graph.outputs))
    }
    return sides | {"operations": graph.operations}


def write_arrays(path: Path, graph: Graph) -> None:
    """Write the constants of a graph."""
    write_atomically(path, lambda file: np.savez(file, allow_pickle=False, **graph.constants))

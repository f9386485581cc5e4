"""Old names: of arrays in checkpoints and assigners, of keys in files, of metrics, and of options of the command line."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["rename_assigner", "rename_fields", "rename_keys", "rename_metrics", "rename_options"]

_RENAMED_KEYS = {
    "cards": "accelerators",
    "drawn_steps": "sampled_steps",
    "judged_from": "credit_scope",
    "judges": "scored_observation",
}
"""From old to new keys of tasks, settings, sweeps and assigners, and to new options of the command line."""

_RENAMED_OPTIONS = {"credit.episodes": "credit.batch-episodes", "credit.steps": "credit.batch-steps"}
"""From old to new options whose last part alone is no old name."""

_FREE_TABLES = {"arguments", "functions"}
"""Tables with other keys, which stay: an environment's keyword arguments, and names of tasks."""

_RENAMED_METRICS = {"likeliest_return": "deterministic_return"}
"""From old to new metrics, after the slash."""

_RENAMED_ASSIGNER = {
    "features": "inputs",
    "fits": "n_updates",
    "steps": "n_added",
    "told": "n_learned",
    "tried/action": "phi_sample/action",
    "tried/observation": "phi_sample/observation",
}
"""From old to new names of keys and arrays in the files of a `CreditAssigner`."""

_RENAMED_FIELDS = {
    "average": "is_average",
    "is_mean": "is_average",
    "closed": "closed_form",
    "counted": "n_learned",
    "credit": "decoders",
    "determined": "n_effective",
    "deviation": "std",
    "done": "n_due",
    "fitted": "n_fitted",
    "given": "input_projection",
    "kept": "hidden_projection",
    "log_deviation": "log_std",
    "memory": "gru",
    "n_determined": "n_effective",
    "of_mean": "centre_variance",
    "recurrent": "gru",
    "reward_sources": "decoders",
    "over_agents": "agent_blocks",
    "over_time": "time_blocks",
    "rivals": "score_type_predictions",
    "rows": "n_rows",
    "score": "return_",
    "spread": "covariance",
    "squares": "sum_squares",
    "steps": "n_steps",
    "summed": "sufficient_statistics",
}
"""From old to new fields of states."""

_DECODER = r"(?:\.decoders\[\d+\]|^\[0\])"
"""Matches the path of a decoder in a checkpoint, or in an assigner."""
_NETWORK = rf"({_DECODER}\.(?:network|.*\.(?:mu|nu)))"
"""Matches the path of its network, or of one of Adam's moments, which have the same fields."""
_RENAMED_PATHS = {
    r"\.agent\.decoder\b": ".agent.head",
    r"^\.algorithm\.qmix\b": ".algorithm.networks",
    r"^\.algorithm\.states\b": ".algorithm.mixer_statistics",
    rf"({_DECODER})\.decoder\b": r"\1.network",
    rf"{_NETWORK}\.network\b": r"\1.mlp",
    rf"{_NETWORK}\.decoder\.network\b": r"\1.step_decoder.mlp",
    rf"{_NETWORK}\.step$": r"\1.position",  # STAS
    rf"{_NETWORK}\.(agent_)?numbers?$": r"\1.index_embeddings",
    rf"{_NETWORK}\.last(?=\.(weight|bias)$)": r"\1.head",
    rf"{_NETWORK}\.value\.": r"\1.readout.",  # Diaster
    rf"{_NETWORK}\.step\.": r"\1.step_model.",
    r"^\.replay\.transitions\b": ".replay.next_transition",
    r"^\.replay((?:\.segments)?)\.episodes\b": r".replay\1.current_episode",
    r"\.episodes\b": ".n_episodes",
    r"^\.scales?\b": ".decoders",
    r"^\[1\]": "[0]",  # the scale of an assigner
    rf"({_DECODER})(?=\.(n_episodes|mean_square|lowest|highest)$)": r"\1.scale",
    r"(^|\.algorithm|\.actor)\.(return|observation)s(?=\.(n_rows|mean|sum_squares)$)": r"\1.\2_rms",  # PPO
}
"""From patterns of old names to new names, in the order in which they are applied."""


def rename_keys(values: Any) -> Any:
    """Return a table, with the tables in it, under the present names of keys.

    If a table has both names of a key, both stay, and the reader of the table refuses the old one as unknown.
    """
    if isinstance(values, list):
        return [rename_keys(value) for value in values]
    if not isinstance(values, Mapping):
        return values
    names = {name: new for name, new in _RENAMED_KEYS.items() if new not in values}
    free = {name: values[name] for name in _FREE_TABLES & values.keys()}
    return {names.get(name, name): rename_keys(value) for name, value in values.items()} | free


def rename_assigner(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys, or the arrays, of a saved `CreditAssigner` under their present names."""
    return {_RENAMED_ASSIGNER.get(name, name): value for name, value in values.items()}


def rename_metrics(line: Mapping[str, Any]) -> dict[str, Any]:
    """Return a line of metrics.jsonl under the present names of metrics."""

    def rename(name: str) -> str:
        group, slash, metric = name.rpartition("/")
        return f"{group}{slash}{_RENAMED_METRICS.get(metric, metric)}"

    return {rename(name): value for name, value in line.items()}


def rename_options(arguments: Sequence[str]) -> list[str]:
    """Return arguments of the command line under the present names of options."""

    def rename(argument: str) -> str:
        option, equals, value = argument.partition("=")
        table, dot, name = option.removeprefix("--").rpartition(".")
        new_name = _RENAMED_KEYS.get(name.replace("-", "_"), name).replace("_", "-")
        new_option = _RENAMED_OPTIONS.get(f"{table}{dot}{name}", f"{table}{dot}{new_name}")
        is_old = option.startswith("--") and new_option != f"{table}{dot}{name.replace('_', '-')}"
        return f"--{new_option}{equals}{value}" if is_old else argument

    return list(map(rename, arguments))


def rename_fields(name: str) -> str:
    """Return the present path of an array: `.credit[0].average` becomes `.decoders[0].is_average`."""
    name = re.sub(r"(?<=\.)\w+", lambda match: _RENAMED_FIELDS.get(match.group(), match.group()), name)
    for pattern, new in _RENAMED_PATHS.items():
        name = re.sub(pattern, new, name)
    return name

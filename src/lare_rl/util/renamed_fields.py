"""Names of arrays in checkpoints and assigners that an earlier version has saved. A name is made of the fields of a state."""

import re

__all__ = ["rename_fields"]

_RENAMED_FIELDS = {
    "average": "is_mean",
    "closed": "closed_form",
    "counted": "n_learned",
    "credit": "decoders",
    "determined": "n_determined",
    "deviation": "std",
    "done": "n_due",
    "fitted": "n_fitted",
    "given": "input_projection",
    "kept": "hidden_projection",
    "log_deviation": "log_std",
    "memory": "gru",
    "of_mean": "centre_variance",
    "recurrent": "gru",
    "over_agents": "agent_blocks",
    "over_time": "time_blocks",
    "rivals": "score_type_predictions",
    "rows": "n_rows",
    "squares": "sum_squares",
    "steps": "n_steps",
    "summed": "sufficient_statistics",
}
"""From old to new names."""


def rename_fields(name: str) -> str:
    """Return the present name of an array, such as `.decoders[0].is_mean` for `.credit[0].average`."""
    name = re.sub(r"(?<=\.)\w+", lambda match: _RENAMED_FIELDS.get(match.group(), match.group()), name)
    name = re.sub(r"\.agent\.decoder\b", ".agent.head", name)
    for stas_field, present in (
        ("step$", "position"),
        ("number$", "agent_number"),
        (r"last(?=\.(weight|bias)$)", "head"),
    ):
        name = re.sub(rf"(\.decoders\[.*)\.{stas_field}", rf"\1.{present}", name)
    for diaster_field, present in (("value", "readout"), ("step", "step_model")):
        name = re.sub(rf"(\.decoders\[.*\.(?:decoder|mu|nu))\.{diaster_field}\.", rf"\1.{present}.", name)
    return re.sub(r"(?<!\.replay)\.episodes\b", ".n_episodes", name)

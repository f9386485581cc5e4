"""Which settings a run uses: others make no difference to its task, algorithm and method."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lare_rl.algorithms.registry import ALGORITHMS, Consumes
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS, Fit, Method
from lare_rl.tasks.spec import TaskSpec

__all__ = [
    "describe_unused_settings",
    "dump_by_algorithm",
    "effective_settings",
    "fits_separately",
    "reads_old_steps",
    "unused_names",
    "warmup_warning",
]


def effective_settings(settings: ResolvedSettings) -> dict[str, Any]:
    """Return the settings that a run uses, by dotted names as on the command line."""
    values = dump_by_algorithm(settings)
    if settings.scored_observation is None:
        values["scored_observation"] = "as the task says"
    unused = unused_names(settings)
    return {name: value for name, value in _flatten(values) if not _is_under(name, unused)}


def dump_by_algorithm(settings: ResolvedSettings) -> dict[str, Any]:
    """Return all settings as plain data. The hyperparameters are under the name of their algorithm, as in `Settings`."""
    values = settings.model_dump()
    values[settings.algorithm] = values.pop("hyperparameters")
    return values


def describe_unused_settings(settings: Settings, resolved: ResolvedSettings, task: TaskSpec) -> dict[str, str]:
    """Return a message about each setting that a user changed and the run does not use, by dotted names."""
    defaults, effective = dict(_flatten(Settings().model_dump())), effective_settings(resolved)
    other_algorithms = [name for name in ALGORITHMS if name != resolved.algorithm]
    unused = unused_names(resolved)
    messages = {}
    for name, value in _flatten(settings.model_dump(exclude_unset=True)):
        if name in defaults and value == defaults[name]:
            continue
        if _is_under(name, other_algorithms):
            alternative = f"{resolved.algorithm}.{name.rpartition('.')[2]}"
            hint = f"; use {alternative}" if alternative in effective else ""
            messages[name] = f"{name} makes no difference to {resolved.algorithm} on {task.name}{hint}"
        elif _is_under(name, unused):
            messages[name] = f"{name} makes no difference to {resolved.method} with {resolved.algorithm} on {task.name}"
    return messages


def unused_names(settings: ResolvedSettings) -> list[str]:
    """Return the dotted names of settings that this algorithm and method do not use."""
    method, algorithm = METHODS.find(settings.method), ALGORITHMS[settings.algorithm]
    on_policy = algorithm.consumes is Consumes.ROLLOUTS
    has_fits = fits_separately(method, algorithm.consumes)
    is_used = {
        "fit_every": has_fits,
        "fit_updates": has_fits,
        "first_fit": has_fits and on_policy and algorithm.multi_agent,
        "scored_observation": method.uses_scored_observation,
        "draw": method.needs_phi,
        "candidates": method.needs_phi,
        "capacity": reads_old_steps(settings),
        "scale_rewards": not on_policy,
    }
    is_used |= {f"{settings.algorithm}.{name}": False for name in settings.hyperparameters.unused_names}
    is_used |= {f"credit.{name}": name in method.settings for name in CreditSettings.model_fields}
    return [name for name, used in is_used.items() if not used]


def fits_separately(method: Method, consumes: Consumes) -> bool:
    """Return whether the decoder makes its gradient updates in a step of their own, before those of the algorithm.

    Otherwise, a decoder with gradient updates makes one with each update of the algorithm. Its own loss would be too expensive for that.
    """
    return method.uses_gradient and (consumes is Consumes.ROLLOUTS or method.fit is Fit.DECODER_LOSS)


def reads_old_steps(settings: ResolvedSettings) -> bool:
    """Return whether updates read steps of earlier iterations."""
    consumes = ALGORITHMS[settings.algorithm].consumes
    return consumes is not Consumes.ROLLOUTS or METHODS.find(settings.method).fit is not None


def warmup_warning(settings: ResolvedSettings) -> str | None:
    """Return a warning if all steps are random, so that the policy is never updated."""
    if settings.warmup < settings.steps:
        return None
    name = f"{settings.algorithm}.warmup"
    return (
        f"the policy is never trained: the first {settings.warmup:,} steps are random ({name}), and the run has {settings.steps:,}. "
        f"Use more steps or a smaller {name}"
    )


def _is_under(name: str, groups: Sequence[str]) -> bool:
    """Return whether a dotted name is one of these groups, or lies in one of them."""
    return any(f"{name}.".startswith(f"{group}.") for group in groups)


def _flatten(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted names and the values of nested settings."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value

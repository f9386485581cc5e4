"""Which settings make a difference to a run, and what follows from their combination."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lare_rl.algorithms.registry import ALGORITHMS, Consumes
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import find_method
from lare_rl.tasks.spec import TaskSpec

__all__ = ["effective_settings", "needs_replay", "unused_settings", "warmup_warning"]


def effective_settings(settings: ResolvedSettings, task: TaskSpec) -> dict[str, Any]:
    """Return all settings that make a difference to the run, by dotted names as on the command line."""
    values = settings.model_dump()
    if settings.judges is None:
        values["judges"] = "as the task says"
    values[settings.algorithm] = values.pop("hyperparameters")
    ineffective = ineffective_names(settings)
    return {name: value for name, value in _flatten(values) if not _is_in(name, ineffective)}


def unused_settings(settings: Settings, resolved: ResolvedSettings, task: TaskSpec) -> dict[str, str]:
    """Return messages, by dotted names, about settings that are given but make no difference to this task, algorithm and method."""
    defaults, effective = dict(_flatten(Settings().model_dump())), effective_settings(resolved, task)
    other_algorithms = [name for name in ALGORITHMS if name != resolved.algorithm]
    ineffective = ineffective_names(resolved)
    messages = {}
    for name, value in _flatten(settings.model_dump(exclude_unset=True)):
        if name in defaults and value == defaults[name]:
            continue
        if _is_in(name, other_algorithms):
            alternative = f"{resolved.algorithm}.{name.rpartition('.')[2]}"
            hint = f"; it has {alternative}" if alternative in effective else ""
            messages[name] = f"{name} makes no difference to {resolved.algorithm} on {task.name}{hint}"
        elif _is_in(name, ineffective):
            by_algorithm = name in ("scale_rewards", f"{resolved.algorithm}.noise_clip")
            cause = f"{resolved.algorithm} on {task.name}" if by_algorithm else resolved.method
            messages[name] = f"{name} makes no difference to {cause}"
    return messages


def ineffective_names(settings: ResolvedSettings) -> list[str]:
    """Return the dotted names of settings that make no difference to this algorithm and method."""
    method, algorithm = find_method(settings.method), ALGORITHMS[settings.algorithm]
    on_policy = algorithm.consumes is Consumes.ROLLOUTS
    separate_fit = method.fit is not None and method.fit.separate
    effects = {
        "fit_every": method.uses_gradient and (on_policy or separate_fit),
        "fit_updates": method.uses_gradient and (on_policy or separate_fit),
        "first_fit": method.uses_gradient and on_policy and algorithm.multi_agent,
        "judges": method.uses_factor_inputs,
        "draw": method.needs_phi,
        "candidates": method.needs_phi,
        "capacity": needs_replay(settings),
        "scale_rewards": not on_policy,
        f"{settings.algorithm}.noise_clip": getattr(settings.hyperparameters, "policy_noise", None) != 0,
    }
    effects |= {f"credit.{name}": name in method.settings for name in CreditSettings.model_fields}
    return [name for name, has_effect in effects.items() if not has_effect]


def needs_replay(settings: ResolvedSettings) -> bool:
    """Return whether steps are read again after the policy has learned from them."""
    consumes = ALGORITHMS[settings.algorithm].consumes
    return consumes is not Consumes.ROLLOUTS or find_method(settings.method).fit is not None


def warmup_warning(settings: ResolvedSettings) -> str | None:
    """Return a warning if all steps are random, so that the policy is never updated."""
    if settings.warmup < settings.steps:
        return None
    name = f"{settings.algorithm}.warmup"
    return (
        f"all {settings.steps:,} steps are random, and the policy is not trained: {name} is {settings.warmup:,}; use more steps or "
        f"a smaller {name}"
    )


def _is_in(name: str, groups: Sequence[str]) -> bool:
    """Return whether a dotted name is one of these groups, or lies in one of them."""
    return any(f"{name}.".startswith(f"{group}.") for group in groups)


def _flatten(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted names and the values of nested settings."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value

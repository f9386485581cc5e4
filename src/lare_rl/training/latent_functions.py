"""Chooses the latent functions that a run is trained with."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from lare_rl.config.settings import ResolvedSettings
from lare_rl.config.validity import check_phi
from lare_rl.credit.methods import METHODS
from lare_rl.errors import LareError, short_repr
from lare_rl.latent.design import design
from lare_rl.latent.function import LatentFunction, check_task, pair_with_roles
from lare_rl.latent.saved import load_function
from lare_rl.llm.prompts import N_CANDIDATES
from lare_rl.tasks.spec import TaskSpec

__all__ = ["FunctionOrPath", "choose_functions"]

FunctionOrPath = LatentFunction | str | Path
"""A latent function, or the path of its file."""


def choose_functions(
    task: TaskSpec, settings: ResolvedSettings, function: FunctionOrPath | Sequence[FunctionOrPath] | None
) -> tuple[LatentFunction, ...]:
    """Return one function for each role of the task: the user's, or from the shipped recordings. Empty for a method without phi.

    Raises:
        LareError: a function cannot be used, or the method needs none.
    """
    method = METHODS.find(settings.method)
    if not method.needs_phi:
        if function is not None:
            raise LareError(
                f"{method.name} needs no latent function, and one is given: leave out --function (in Python: function)"
            )
        return ()
    if function is None:
        design_role = partial(design, kind=method.phi_kind, draw=settings.draw, candidates=settings.candidates)
        functions = [design_role(role) for role in task.roles]
    else:
        if (settings.draw, settings.candidates) != (0, N_CANDIDATES):
            raise LareError("draw and candidates choose a recorded function, and a function is given: leave either out")
        chosen = [function] if isinstance(function, FunctionOrPath) else function
        if not isinstance(chosen, Sequence) or not all(isinstance(choice, FunctionOrPath) for choice in chosen):
            raise LareError(
                "a latent function must be the path of its file, or come from lare_rl.design or lare_rl.load_function, and is "
                f"{short_repr(function)}: write its source to a file, which is verified"
            )
        functions = [_load_function(choice, role) for choice, role in pair_with_roles(chosen, task)]
    for function in functions:
        check_phi(method, function, settings.choose_scored_observation(task))
    return tuple(functions)


def _load_function(function: FunctionOrPath, role: TaskSpec) -> LatentFunction:
    if not isinstance(function, LatentFunction):
        return load_function(function, role)
    check_task(function, role)
    return function

"""The fixed configuration of a `CreditAssigner`: method, function, spaces and settings; and the decoder's inputs of steps."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, InstanceOf

from lare_rl.assigner.space_layout import SpaceLayout, make_layout
from lare_rl.config.validity import check_credit, check_phi
from lare_rl.credit.decoder_settings import CreditSettings, resolve_credit
from lare_rl.credit.history import next_history_columns
from lare_rl.credit.input_names import N_EXTREMES, input_arrays
from lare_rl.credit.methods import METHODS, Method
from lare_rl.credit.spec import CreditSpec
from lare_rl.envs.families import find_score_key
from lare_rl.envs.load import resolve_task
from lare_rl.envs.placement import load_env_spec
from lare_rl.errors import CheckedModel, Count, LareError, short_repr
from lare_rl.latent.function import LatentFunction, check_task
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule
from lare_rl.tasks.spec import NO_ENVIRONMENT, ScoredObservation, TaskSpec

__all__ = ["AssignerConfig", "Space", "check_config", "resolve_config"]

Space = gymnasium.Space | SpaceLayout | int | np.integer
"""A space of Gymnasium, a layout, or the length of a row of numbers."""


class AssignerConfig(CheckedModel):
    """The configuration of an assigner."""

    method: InstanceOf[Method]
    phi: InstanceOf[LatentFunction] | None
    task: TaskSpec | None
    observation: SpaceLayout
    action: SpaceLayout
    scored_observation: ScoredObservation
    agents: Count
    max_steps: Count | None
    capacity: Count
    settings: CreditSettings
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    fits_per_step: Annotated[float, Field(ge=0)]
    scale_rewards: bool
    forget: bool
    payments: PaymentRule = PAID_AT_END
    groups: bool = False

    @property
    def agent_axis(self) -> tuple[int, ...]:
        """The axis of agents in the user's arrays; empty for a single agent."""
        return (self.agents,) if self.agents > 1 else ()

    @cached_property
    def spec(self) -> CreditSpec:
        """What is fitted to the returns."""
        return CreditSpec(
            method=self.method,
            settings=self.settings,
            n_factors=0 if self.phi is None else self.phi.n_factors(self.scored_observation),
            observation_size=self.observation.size,
            action_size=self.action.size,
            scored_observation=self.scored_observation,
            single_agent=self.agents == 1,
            agents=self.agents,
            max_steps=self.max_steps or 1,
            payments=self.payments,
            has_groups=self.groups,
            scale_rewards=self.scale_rewards,
        )

    @property
    def group_key(self) -> str:
        """The key of an episode's group in `info`."""
        return "group" if self.task is None or self.task.group is None else self.task.group

    @property
    def raw_feature_names(self) -> list[str]:
        """Names of the raw features; none if they are not entries of observations and the action."""
        texts = ("", "") if self.task is None else (self.task.observation, self.task.action)
        return self.spec.raw_feature_names(*texts)

    def compute_inputs(
        self, observation: np.ndarray, action: np.ndarray, next_observation: np.ndarray
    ) -> Float[np.ndarray, "n *agents inputs"]:
        """Compute the decoder's inputs for some steps, which are rows already, without their history.

        Raises `LareError` if a factor is not finite.
        """
        arrays = {"observation": observation, "action": action, "next_observation": next_observation}
        if self.phi is not None:
            arrays["factors"] = self.phi.step_factors(observation, action, next_observation, self.scored_observation)
        names = tuple(name for name in self.spec.inputs if name != "history")
        inputs = input_arrays(names, arrays)
        return np.concatenate(inputs, axis=-1) if inputs else observation[..., :0]

    def add_history(
        self, inputs: Float[np.ndarray, "n *agents inputs"], begins: Bool[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n *agents all_inputs"]:
        """Return the inputs of successive steps with their history. `begins` is true for the first step of each episode."""
        n_tracked, size = self.spec.basis.n_tracked, inputs.shape[-1]
        rows = np.concatenate(
            [inputs, np.full((*inputs.shape[:-1], N_EXTREMES * n_tracked), np.nan, np.float32)], axis=-1
        )
        for i in np.flatnonzero(~begins):
            if i:
                rows[i, ..., size:] = next_history_columns(rows[i - 1], n_tracked)
        return rows


def resolve_config(
    method: str | None,
    phi: LatentFunction | None,
    task: TaskSpec | str | Path | None,
    settings: CreditSettings | None,
    spaces: Mapping[str, Space | None],
    *,
    scored_observation: ScoredObservation | None,
    payments: PaymentRule | None,
    groups: bool | None,
    agents: int,
    **values: Any,
) -> AssignerConfig:
    """Return the configuration for arguments of `CreditAssigner`. If an argument is None, the task decides it.

    Raises:
        LareError: there is no such method or task, or the spaces are not those of the task.
    """
    task = None if task is None else resolve_task(task, playable=False)
    chosen = METHODS.find(method or ("bayes" if phi is None else "lare-bayes"))
    if phi is not None and not isinstance(phi, LatentFunction):
        raise LareError(f"phi is {short_repr(phi)}: give a function from lare_rl.design or lare_rl.load_function")
    settings = resolve_credit(settings, agents)
    if settings.score == "auto" and task is not None and (score := find_score_key(task)) is not None:
        settings = settings.model_copy(update={"score": score})
    observation, action = _resolve_layouts(task, spaces)
    return AssignerConfig(
        method=chosen,
        phi=phi,
        task=task,
        observation=observation,
        action=action,
        settings=settings.model_copy(update={"exact": chosen.choose_exact(settings.exact)}),
        scored_observation=scored_observation or ("after" if task is None else task.scored_observation),
        payments=payments or (PAID_AT_END if task is None else task.payment_rule),
        groups=(task is not None and task.group is not None) if groups is None else groups,
        agents=agents,
        **values,
    )


def _resolve_layouts(task: TaskSpec | None, spaces: Mapping[str, Space | None]) -> list[SpaceLayout]:
    """Return the layouts of observations and actions. Raises `LareError` if there is no space and no task, or the two differ."""
    layouts = []
    for name, space in spaces.items():
        layout = make_layout(_task_space(task, name) if space is None else space, f"{name}_space")
        if task is not None and layout.size != (size := getattr(task, f"{name}_size")):
            raise LareError(
                f"{name}_space has rows of {layout.size} numbers, but task {task.name!r} has {name}_size = {size}"
            )
        layouts.append(layout)
    return layouts


def _task_space(task: TaskSpec | None, name: str) -> Space:
    """Return the space of a task's observations or actions, or their length."""
    if task is None:
        raise LareError("CreditAssigner needs observation_space and action_space, or a task")
    if name == "observation":
        return task.observation_size
    if task.environment == NO_ENVIRONMENT:
        raise LareError(
            f"task {task.name!r} has no environment: give action_space, a Gymnasium space or the length of an action"
        )
    env = load_env_spec(task)
    return gymnasium.spaces.Discrete(task.action_size, start=env.first_choice) if env.discrete else task.action_size


def check_config(config: AssignerConfig) -> None:
    """Raise `LareError` if method, function and sizes do not go together."""
    method, phi, name = config.method, config.phi, config.method.name
    if not method.has_proxy_rewards:
        raise LareError(f"{name} assigns no credit: train on what the environment pays")
    if phi is not None and method.needs_phi:
        if config.task is None:
            raise LareError("a phi needs the task that it was designed for: CreditAssigner(..., phi, task=task)")
        check_task(phi, config.task)
    check_credit(config.spec, config.agents)
    check_phi(method, phi, config.scored_observation)
    if config.agents > 1 and config.max_steps is None and method.uses_gradient:
        raise LareError(f"{name} of many agents needs max_steps, the number of steps of the longest episode")

"""The fixed configuration of a `CreditAssigner`: method, function, spaces and settings; and the features of steps."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Bool, Float

from lare_rl.assigner.layout import Layout, layout_of
from lare_rl.credit.basis import MOST_ENTRIES, Basis
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decomposition import SUM, forms_of
from lare_rl.credit.methods import Decoder, Encoder, Fit, Method, Reward
from lare_rl.envs.families import env_spec
from lare_rl.errors import LareError, shortened
from lare_rl.latent.function import LatentFunction, check_task
from lare_rl.tasks.spec import Judges, TaskSpec, judged_states

Space = gymnasium.Space | Layout | int
"""A space of Gymnasium, a layout, or the number of entries of a row."""


@dataclass(frozen=True)
class CreditConfig:
    """The configuration of an assigner."""

    method: Method
    phi: LatentFunction | None
    task: TaskSpec | None
    observation: Layout
    action: Layout
    judges: Judges
    agents: int
    max_steps: int | None
    capacity: int
    settings: CreditSettings
    seed: int
    fits_per_step: float
    scale_rewards: bool
    forget: bool

    @property
    def axis(self) -> tuple[int, ...]:
        """The axis of agents; empty for a single agent."""
        return (self.agents,) if self.agents > 1 else ()

    @property
    def factors(self) -> int:
        """The number of factors of a step."""
        return self.phi.size_by(self.judges) if self.phi is not None else 0

    @property
    def entries(self) -> int:
        """The number of raw entries in the decoder's input for a step."""
        shown, action = self.observation.size, self.action.size
        match self.method.encoder:
            case None | Encoder.LATENT:
                return 0
            case Encoder.RAW:
                return 2 * shown + action if self.agents == 1 else shown
            case Encoder.JUDGED | Encoder.LATENT_AND_JUDGED:
                return shown * len(judged_states(self.judges, 0, 1)) + action
            case _:
                return shown + action

    @property
    def basis(self) -> Basis:
        """The features that a closed-form decoder computes from a row."""
        return Basis(self.factors, self.entries, extended=self.method.decoder is Decoder.ADDITIVE)

    @property
    def forms(self) -> tuple[int, ...]:
        """Which forms of the score are fitted."""
        return forms_of(self.settings, fixed_length=False) if "score" in self.method.settings else (SUM,)

    def features(self, before: np.ndarray, action: np.ndarray, after: np.ndarray) -> Float[np.ndarray, "n *agents _"]:
        """The decoder's inputs for some steps, which are rows already."""
        parts = []
        if self.phi is not None:
            one, done, other = (part.reshape(-1, part.shape[-1]) for part in (before, action, after))
            parts.append(self.phi.of_steps(one, done, other, self.judges).reshape(*before.shape[:-1], -1))
        match self.method.encoder:
            case Encoder.RAW:
                parts += [before, action, before - after] if self.agents == 1 else [after]
            case Encoder.STATE_ACTION:
                parts += [before, action]
            case Encoder.NEXT:
                parts += [after, action]
            case Encoder.JUDGED | Encoder.LATENT_AND_JUDGED:
                parts += [*judged_states(self.judges, before, after), action]
        return np.concatenate(parts, axis=-1) if parts else before[..., :0]

    def rows(self, before: Any, action: Any, after: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Steps as rows of numbers. Raises `LareError` if their shapes do not fit together."""
        found = {
            "before": self.observation.rows(before, "before"),
            "action": self.action.rows(action, "action"),
            "after": self.observation.rows(after, "after"),
        }
        lead = (len(found["before"]) if found["before"].ndim > 1 else 0, *self.axis)
        for name, values in found.items():
            if values.shape[:-1] != lead:
                wanted = ", ".join(["steps", *map(str, self.axis), str(values.shape[-1])])
                also = "" if name == "before" else ", as many as before has"
                raise LareError(f"{name} must be rows ({wanted}){also}, and its shape is {values.shape}")
        return found["before"], found["action"], found["after"]

    def team_reward(
        self, reward: Any, alive: Any, count: int
    ) -> tuple[np.ndarray, Bool[np.ndarray, "n agents"] | None]:
        """The team's reward for each of some steps, and which agents were alive, if that is given."""
        paid = np.asarray(reward, np.float64)
        there = None if alive is None else np.asarray(alive, bool)
        if there is not None and (there.shape != (count, self.agents) or self.agents == 1):
            raise LareError(f"alive must be ({count}, agents) of more than one agent, and its shape is {there.shape}")
        if self.agents > 1 and paid.shape == (count, self.agents):
            weight = np.ones_like(paid) if there is None else there
            return (paid * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1), there
        if paid.shape != (count,):
            raise LareError(f"reward must be one number for each of {count} steps, and its shape is {paid.shape}")
        return paid, there


def layouts(task: TaskSpec | None, spaces: Mapping[str, Space | None]) -> list[Layout]:
    """The layouts of observations and actions.

    Raises:
        LareError: there is neither a space nor a task, or the two differ.
    """
    found = []
    for name, space in spaces.items():
        if space is None and task is None:
            raise LareError("CreditAssigner needs observation_space and action_space, or a task")
        size = getattr(task, f"{name}_size", 0)
        if space is None:
            choice = name == "action" and task is not None and env_spec(task).discrete
            space = gymnasium.spaces.Discrete(size) if choice else size
        layout = layout_of(space, f"{name}_space")
        if task is not None and layout.size != size:
            raise LareError(
                f"{name}_space has rows of {layout.size} numbers, and task {task.name!r} has {name}_size = {size}"
            )
        found.append(layout)
    return found


def check(config: CreditConfig) -> None:
    """Raise `LareError` if method, function and sizes do not go together."""
    method, phi, name = config.method, config.phi, config.method.name
    if not isinstance(config.capacity, int) or config.capacity < 1:
        raise LareError(f"capacity = {shortened(config.capacity)}: it is a whole number, 1 or more")
    if not method.has_proxy:
        raise LareError(f"{name} assigns no credit: train on what the environment pays")
    if method.whole_episodes:
        raise LareError(f"{name} looks at whole episodes at once, not at sampled steps: use it with `lare_rl.train`")
    if phi is not None and not isinstance(phi, LatentFunction):
        raise LareError(f"phi must be a function from lare_rl.design or lare_rl.load_function, and is {shortened(phi)}")
    if method.latent and phi is None:
        raise LareError(f"{name} needs a phi; bayes, rd and rrdu need none")
    if phi is not None and not method.latent:
        raise LareError(f"{name} needs no phi: leave it out, or take lare-bayes")
    if phi is not None and phi.kind != method.kind:
        raise LareError(f"{name} needs a phi of the kind {method.kind!r}, and this one is of the kind {phi.kind!r}")
    if phi is not None and config.task is None:
        raise LareError("a phi needs the task that it was designed for: CreditAssigner(..., phi, task=task)")
    if phi is not None and config.task is not None:
        check_task(phi, config.task)
    if method.reward is Reward.DESIGNED and config.judges == "both":
        raise LareError(f"{name} is one reward a step: it judges the observation before or after, not both")
    if method.for_one_only and config.agents > 1:
        raise LareError(f"{name} assigns credit to a single agent, and agents = {config.agents}")
    if method.for_many_only and config.agents == 1:
        raise LareError(f"{name} assigns credit among agents, and agents = 1")
    if config.agents > 1 and config.max_steps is None:
        raise LareError("many agents need max_steps, the steps of the longest episode")
    if config.scale_rewards and not method.in_reward_units:
        raise LareError(f"scale_rewards divides by the size of returns, and rewards of {name} are not in their unit")
    if method.fit is Fit.EVIDENCE and not method.latent and config.entries > MOST_ENTRIES:
        raise LareError(
            f"{name} fits a weight to each of at most {MOST_ENTRIES} entries, and there are {config.entries}: use rrdu, a network"
        )
    drawn, steps = config.settings.drawn_steps, config.settings.steps
    if "drawn_steps" in method.settings and steps < drawn:
        raise LareError(f"settings.steps = {steps} is less than settings.drawn_steps = {drawn}, of one episode")

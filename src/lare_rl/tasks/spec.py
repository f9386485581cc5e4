"""A task: an environment and the texts that describe it."""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BeforeValidator, ConfigDict, Field, StrictInt, field_validator, model_validator

from lare_rl.errors import CheckedModel, Count, LareError, short_repr
from lare_rl.tasks.payments import PaymentRule

__all__ = [
    "FILL_IN",
    "MAX_LEVELS",
    "NO_ENVIRONMENT",
    "PETTINGZOO_PREFIX",
    "SHARED_KEYS",
    "CreditScope",
    "ScoredObservation",
    "TaskSpec",
    "base_name",
    "check_same_tasks",
    "entry_meanings",
    "names_by_side",
    "require_role",
    "select_sides",
    "split_environment",
    "unwritten_texts",
]

ScoredObservation = Literal["before", "after", "both"]
"""See `TaskSpec.scored_observation`. With `both`, `phi` is called on each observation, and the factors are concatenated. The input
`scored_observation` of a decoder is then both observations."""

Side = TypeVar("Side")
"""What belongs to the time before an action, or after it: observations, time steps or texts."""

CreditScope = Literal["observation", "state"]
"""See `TaskSpec.credit_scope`."""

PETTINGZOO_PREFIX = "pettingzoo/"
"""The prefix of the names of PettingZoo environments. The rest is MODULE:NAME."""

SHARED_KEYS = (
    "environment",
    "evaluation_environment",
    "arguments",
    "max_episode_steps",
    "credit_scope",
    "scored_observation",
    "payments",
    "paid_for",
    "group",
    "processes",
    "timeout",
)
"""Keys that a team inherits from its task. The team's own file may repeat them, so that it can be used alone, but with the same
values."""

MAX_LEVELS = 64
"""The number of levels that `group` may tell apart."""

NO_ENVIRONMENT = "none"
"""The value of `environment` for a task with logs only, whose environment is not available."""

RESERVED_METRICS = frozenset({"return", "return_std", "deterministic_return", "summed_return", "length"})
"""Names of an evaluation's own metrics, which no measure may have."""

FILL_IN = "FILL IN"
"""The placeholder in a draft for texts that must be written before a language model reads them."""


class PaidSteps(CheckedModel):
    """The value of `paid_for` if each payment is for a fixed number of steps."""

    steps: Annotated[StrictInt, Field(ge=1)]
    """A payment is for this many of the last steps, the one that is paid included."""


def _number_to_paid_steps(value: Any) -> Any:
    """Read `paid_for = 20` as `paid_for = { steps = 20 }`."""
    return {"steps": value} if type(value) is int else value


def _to_json(value: Any) -> Any:
    """Return arguments as the file of a run stores them: with lists instead of tuples. Raises `ValueError` if JSON cannot."""
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: _to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(item) for item in value]
    if value is None or isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise ValueError(
        f"{short_repr(value)} cannot be stored as JSON. Use finite numbers, texts, booleans, lists and tables with texts as keys."
    )


class TaskSpec(CheckedModel):
    """A task: an environment and the texts that describe it."""

    model_config = ConfigDict(str_strip_whitespace=True)

    name: Annotated[str, Field(pattern=r"^\.*[\w\-][\w.\-]*$")]
    """Name in commands and of runs."""
    environment: Annotated[str, Field(min_length=1)]
    """A Gymnasium id (`module:id` first imports the module that registers it), another family's name, such as `particles/CN-6`,
    or `none` for logs: `design` and `relabel` work, `train` does not."""
    evaluation_environment: str | None = None
    """The environment of evaluations, such as held-out maps, years or demand, with the same module and sizes. Only on the host.
    By default, `environment`."""
    observation_size: Count
    """Number of entries of an observation; with `credit_scope = "state"`, of the global state."""
    action_size: Count
    """Number of entries of a continuous action, or of discrete actions; with `credit_scope = "state"`, of all agents of the team
    together."""
    scored_observation: ScoredObservation = "after"
    """Observations of a step that factors and raw features are computed from: before the action, after it, or both."""
    description: Annotated[str, Field(min_length=1)]
    """The task and its goal, without a word about the reward."""
    observation: Annotated[str, Field(min_length=1)]
    """What each entry of the observation means."""
    action: Annotated[str, Field(min_length=1)]
    """What each entry of the action means."""
    max_episode_steps: Annotated[int | None, Field(ge=1)] = None
    """Time limit (steps) of an environment without its own, or of the episodes of logs."""
    score: Literal["sum", "average", "binary"] | None = None
    """The form of an episode's return: a sum over its steps; an average or grade, which does not grow with its length; or binary,
    won or lost. By default a sum, unless an average predicts returns clearly better."""
    payments: Literal["end", "nonzero"] | Annotated[StrictInt, Field(ge=1)] = "end"
    """When the environment pays: once, at the end of an episode; with every reward that is not 0; or every so many steps and at
    the end. Rewards between payments are added up."""
    paid_for: Annotated[Literal["since_last"] | PaidSteps, BeforeValidator(_number_to_paid_steps)] = "since_last"
    """Steps that a payment is for: all since the last payment, or `{ steps = 20 }`, the last 20 with the one that is paid."""
    group: str | None = None
    """Key of `info` with the group of an episode, a whole number from 0 to 63: its level, map, weather or demand. Each group has
    an intercept, so that the steps of an easy level get no credit for its higher returns."""
    measures: tuple[str, ...] = ()
    """Keys of the last step's `info` whose values are averaged and reported beside the return."""
    processes: Literal["auto", "separate"] = "auto"
    """`separate`: every environment has its own process, for a simulator that allows one in a process. `auto`: only an
    environment of a package that LaRe does not know, if it starts or steps slowly, or if a second one in the same process fails,
    hangs or changes the first."""
    timeout: Annotated[float, Field(gt=0)] = 120.0
    """Time (s) within which an environment in another process must reply; else the run stops with a message."""
    arguments: Annotated[dict[str, Any], BeforeValidator(_to_json)] = Field(default_factory=dict)
    """Keyword arguments of the environment, for families that take them, such as `pettingzoo/...` and `gymnax/...`."""
    agents: tuple[str, ...] = ()
    """Names of the agents that this file describes, or patterns such as `prey_*`. By default all. For environments whose agents
    have names (`pettingzoo/...`, `jaxmarl/...`)."""
    credit_scope: CreditScope = "observation"
    """Whether `phi` reads each agent's observation and action, or the global state and all actions of the team."""
    teams: tuple["TaskSpec", ...] = ()
    """One task for each team that learns separately, with its own texts. In TOML, the names of their files."""
    team: str | None = None
    """The team that this file describes, if its environment has several."""

    @field_validator("measures")
    @classmethod
    def _check_measures(cls, measures: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(measures)) < len(measures):
            raise ValueError("the same key is listed twice.")
        if reserved := sorted(RESERVED_METRICS.intersection(measures)):
            raise ValueError(f"{reserved[0]!r} is a metric of every evaluation. Give the key of info another name.")
        return measures

    @model_validator(mode="after")
    def _check_teams(self) -> "TaskSpec":
        for team in self.teams:
            if team.environment != self.environment or team.team is None:
                raise ValueError(
                    f"{team.name} is not a team of {self.environment}. Its file needs the same environment, and the key team."
                )
        if len({team.name for team in self.teams}) < len(self.teams):
            raise ValueError("two teams have the same name. Give each team's file its own name.")
        return self

    @model_validator(mode="after")
    def _check_evaluation_environment(self) -> "TaskSpec":
        # A run's file may name any module, but only the module of `environment` is checked for trust before its import.
        other = self.evaluation_environment
        if other is not None and _import_origin(other) != _import_origin(self.environment):
            raise ValueError(
                f"evaluation_environment = {other!r} is not of the module of environment = {self.environment!r}"
            )
        return self

    @property
    def evaluation_task(self) -> "TaskSpec":
        """The same task in the environment that policies are evaluated in."""
        if self.evaluation_environment is None:
            return self
        values = {"environment": self.evaluation_environment, "evaluation_environment": None}
        return self.model_copy(update={**values, "teams": tuple(team.model_copy(update=values) for team in self.teams)})

    @property
    def family(self) -> str:
        """The part of `environment` before the first slash, or "" without a slash."""
        return self.environment.partition("/")[0] if "/" in self.environment else ""

    @property
    def name_in_family(self) -> str:
        """The part of `environment` after the first slash, or "" without a slash."""
        return self.environment.partition("/")[2]

    @property
    def payment_rule(self) -> PaymentRule:
        """When the environment pays, and for which steps."""
        return PaymentRule(
            period=self.payments if isinstance(self.payments, int) else None,
            nonzero=self.payments == "nonzero",
            window=self.paid_for.steps if isinstance(self.paid_for, PaidSteps) else None,
        )

    @property
    def info_keys(self) -> tuple[str, ...]:
        """The keys of the last step's `info` that are read."""
        return self.measures if self.group in (None, *self.measures) else (*self.measures, str(self.group))

    @property
    def roles(self) -> tuple["TaskSpec", ...]:
        """The tasks that latent functions are designed for: those of the teams, or this one."""
        return self.teams or (self,)

    def __hash__(self) -> int:
        """Hash all values. The order of the arguments makes no difference, as in a comparison."""
        return hash(json.dumps(self.model_dump(mode="json"), sort_keys=True))

    @property
    def digest(self) -> str:
        """SHA-256 of all values."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


def select_sides(scored_observation: ScoredObservation, before: Side, after: Side) -> list[Side]:
    """Return what `phi` reads of a step's two sides, in the order in which factors are concatenated."""
    return {"before": [before], "after": [after], "both": [before, after]}[scored_observation]


def names_by_side(scored_observation: ScoredObservation, names: Sequence[str]) -> list[str]:
    """Return the names of the values that are computed from `select_sides`.

    For both sides, each name occurs twice: first all as in `speed (before)`, then all as in `speed (after)`.
    """
    if scored_observation != "both":
        return list(names)
    return [f"{name} ({side})" for side in ("before", "after") for name in names]


def base_name(step_name: str) -> str:
    """Return the name without what `names_by_side` adds."""
    return step_name.removesuffix(" (before)").removesuffix(" (after)")


def entry_meanings(text: str) -> dict[int, str]:
    """Return the meanings of the entries of an observation or action by its text: the line `7: angle of the foot` is about entry 7."""
    lines = re.findall(
        r"^[ \t]*(?:[\-*][ \t]+)*\[?(\d{1,9})\]?[ \t]*[:.)](?!\d)[ \t]*(\S.*)$", text, flags=re.MULTILINE
    )
    return {int(number): meaning.strip() for number, meaning in lines}


def split_environment(name: str) -> tuple[str, str]:
    """Return the module and the name of MODULE:NAME, with or without `pettingzoo/` in front. The module of NAME alone is ""."""
    module, colon, rest = name.removeprefix(PETTINGZOO_PREFIX).partition(":")
    return (module, rest) if colon else ("", module)


def _import_origin(environment: str) -> tuple[bool, str]:
    """Return whether an environment is PettingZoo's, and the module that its name imports, or ""."""
    return environment.startswith(PETTINGZOO_PREFIX), split_environment(environment)[0]


def unwritten_texts(task: TaskSpec) -> list[str]:
    """Return the keys of the texts that still have the placeholder of a draft."""
    return [key for key in ("description", "observation", "action") if FILL_IN in getattr(task, key)]


def check_same_tasks(tasks: Iterable[tuple[Path, TaskSpec]]) -> None:
    """Raise `LareError` if two paths have different tasks of the same name."""
    first: dict[str, tuple[Path, TaskSpec]] = {}
    for path, task in tasks:
        other_path, other = first.setdefault(task.name, (path, task))
        if other != task:
            raise LareError(
                f"{path} and {other_path} have different tasks with the name {task.name}: show them separately"
            )


def require_role(task: TaskSpec) -> TaskSpec:
    """Return a task without teams unchanged. Raise `LareError` for a task with teams, which has several latent functions."""
    if task.teams:
        names = ", ".join(team.name for team in task.teams)
        raise LareError(
            f"{task.name} has teams ({names}), each with its own latent function: give the task file of one team (the key teams lists them)"
        )
    return task

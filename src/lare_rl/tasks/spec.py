"""A task: an environment and the texts that describe it."""

import hashlib
import json
from typing import Annotated, Any, Literal, TypeVar

from pydantic import ConfigDict, Field, field_validator, model_validator

from lare_rl.errors import Checked, LareError

Judges = Literal["before", "after", "both"]
"""The observation by which a step is judged: the one before the action, the one after it, or both. For both, `phi` is called on
each, and the factors are concatenated; so are the raw entries of closed-form decoders."""

State = TypeVar("State")


def judged_states(judges: Judges, before: State, after: State) -> list[State]:
    """The states by which a step is judged, in the order in which they are concatenated."""
    return {"before": [before], "after": [after], "both": [before, after]}[judges]


JudgedFrom = Literal["observation", "state"]
"""The inputs by which a step is judged: each agent's own observation and action, or the global state and all actions, which
are concatenated."""

PETTINGZOO = "pettingzoo/"
"""The prefix of PettingZoo environments in a spec. The rest is MODULE:NAME."""

OF_THE_ENVIRONMENT = ("environment", "arguments", "max_episode_steps", "judged_from", "judges")
"""Keys that a team inherits from its task. The team's own spec may repeat them, so that it can be used alone, but with no other
values."""

NO_ENVIRONMENT = "none"
"""The value of `environment` in a spec for logs, whose environment is not available."""

FILL_IN = "FILL IN"
"""The placeholder in a new spec for texts that must still be written."""


class TaskSpec(Checked):
    """A task: an environment and the texts that describe it."""

    model_config = ConfigDict(str_strip_whitespace=True)

    name: Annotated[str, Field(min_length=1, pattern=r"^[\w.\-]+$")]
    """The name of the task in commands and in the names of runs."""
    environment: Annotated[str, Field(min_length=1)]
    """A Gymnasium id (`module:id` first imports the module that registers it), or the name of another family's environment, such as
    `particles/CN-6`, or `none` if there are only logs: functions are then designed and logs relabelled, but nothing is trained."""
    observation_size: Annotated[int, Field(ge=1)]
    """The number of entries of an observation."""
    action_size: Annotated[int, Field(ge=1)]
    """The number of entries of an action; if the action is a choice, the number of choices."""
    judges: Judges = "after"
    """By which observation a step is judged: the one before it, the one after it, or both."""
    description: Annotated[str, Field(min_length=1)]
    """The task and its goal, without a word about the reward."""
    observation: Annotated[str, Field(min_length=1)]
    """What each entry of the observation means."""
    action: Annotated[str, Field(min_length=1)]
    """What each entry of the action means."""
    max_episode_steps: Annotated[int | None, Field(ge=1)] = None
    """The time limit of an environment that has none of its own, or of the episodes of logs."""
    score: Literal["sum", "average"] | None = None
    """Whether the return of an episode is a sum over its steps, or an average or a grade, which does not grow with the number of
    steps. If it is not set, training determines which of them predicts returns better."""
    measures: tuple[str, ...] = ()
    """Keys of the last step's `info` whose values are averaged and reported in addition to the return."""
    arguments: dict[str, Any] = Field(default_factory=dict)
    """Keyword arguments of the environment. Only for environments that are made from a module (`pettingzoo/...`)."""
    agents: tuple[str, ...] = ()
    """The names of the agents that this spec describes, or patterns of names such as `prey_*`; by default all agents. Only for
    environments whose agents have names (`pettingzoo/...`)."""
    judged_from: JudgedFrom = "observation"
    """Whether `phi` judges each agent's step by the agent's observation, or the whole team's step by the global state."""
    teams: tuple["TaskSpec", ...] = ()
    """If several teams learn separately: one spec for each team, with its own texts. In TOML, the names of these specs."""
    team: str | None = None
    """The team that this spec describes, if its environment has several teams."""

    @field_validator("arguments")
    @classmethod
    def can_be_kept(cls, arguments: dict[str, Any]) -> dict[str, Any]:
        try:
            json.dumps(arguments, allow_nan=False)  # a run stores its task as JSON, which would change such values
        except (TypeError, ValueError):
            raise ValueError("a run cannot store dates, inf or nan: use numbers, strings, lists and tables") from None
        return arguments

    @model_validator(mode="after")
    def is_filled_in(self) -> "TaskSpec":
        for key in ("description", "observation", "action"):
            if FILL_IN in getattr(self, key):
                raise ValueError(f"{key} still says {FILL_IN!r}: replace it by what a language model must know")
        return self

    @model_validator(mode="after")
    def has_teams_of_its_environment(self) -> "TaskSpec":
        for role in self.teams:
            if role.environment != self.environment or role.team is None:
                raise ValueError(
                    f"{role.name} is not a team of {self.environment}: its spec needs the same environment, and the key team"
                )
        return self

    @property
    def family(self) -> str:
        """The part of `environment` before the first slash: see `table.py`."""
        return self.environment.partition("/")[0] if "/" in self.environment else ""

    @property
    def environment_name(self) -> str:
        """The part of `environment` after the first slash."""
        return self.environment.partition("/")[2]

    @property
    def roles(self) -> tuple["TaskSpec", ...]:
        """The specs that latent functions are designed for: those of the teams, or this one."""
        return self.teams or (self,)

    @property
    def digest(self) -> str:
        """SHA-256 of the whole spec."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


def the_role(spec: TaskSpec) -> TaskSpec:
    """The spec, if it describes a single role. Raises `LareError` if its teams have their own specs."""
    if spec.teams:
        names = ", ".join(role.name for role in spec.roles)
        raise LareError(f"{spec.name} has a latent function for each of its teams: name one of {names} instead")
    return spec

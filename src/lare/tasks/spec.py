"""A task: an environment and the texts that describe it, read from TOML and checked against the environment."""

import hashlib
import json
import os.path
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import ConfigDict, Field, field_validator, model_validator

from lare.errors import Checked, LareError, did_you_mean, shortened
from lare.foreign import LARGEST_SETTINGS, read_text, read_toml

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

SHIPPED = files("lare.tasks") / "specs"

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


def shipped_tasks() -> list[str]:
    """Names of the tasks that come with the package."""
    return sorted(entry.name.removesuffix(".toml") for entry in SHIPPED.iterdir() if entry.name.endswith(".toml"))


def as_task(given: TaskSpec | str | Path, playable: bool = True) -> TaskSpec:
    """A task from a spec, a shipped name, or the path of a file.

    Args:
        given: the spec, the name or the path.
        playable: whether the environment must exist and match the task.

    Raises:
        LareError: `given` is none of these; and as for `load_task`.
    """
    if isinstance(given, TaskSpec):
        return given
    if isinstance(given, (str, Path)):
        return load_task(given) if playable else read_task(given)
    raise LareError(f"a task is a shipped name, the path of a task file, or a lare.TaskSpec; it is {shortened(given)}")


def load_task(task: str | Path) -> TaskSpec:
    """Read a task and check it against its environment.

    Args:
        task: a shipped name (`shipped_tasks()`), or the path of a TOML file.

    Raises:
        LareError: there is no such task, the file is not a spec, or the environment does not match the spec.

    >>> load_task("HalfCheetah-v4").action_size
    6
    """
    spec = read_task(task)
    check_against_environment(spec)
    return spec


def read_task(task: str | Path) -> TaskSpec:
    """Read a task without making its environment. Raises `LareError` like `load_task`."""
    values = read_values(str(task))
    try:
        return TaskSpec(**values)
    except LareError as error:
        raise LareError(f"task {str(task)!r}: {error}") from error


def read_values(task: str, seen: tuple[str, ...] = ()) -> dict[str, Any]:
    """The keys of a spec. Missing keys are taken from the spec that it is `like`."""
    if task in shipped_tasks():
        text = (SHIPPED / f"{task}.toml").read_text(encoding="utf-8")
    elif is_file(task):
        text = read_text(Path(task), LARGEST_SETTINGS)
    else:
        if task.endswith(".toml"):
            raise LareError(f"there is no task file {task}")
        if task and os.path.isdir(task):
            raise LareError(
                f"{task} is a folder, and a task is a file (.toml) or a shipped name (lare tasks lists them)"
            )
        hint = did_you_mean(task, shipped_tasks())
        raise LareError(
            f"no task {task!r}{hint}: neither a file nor one of the shipped tasks, {', '.join(shipped_tasks())}"
        )
    try:
        values = read_toml(text)
    except ValueError as error:  # TOMLDecodeError, or a number with too many digits
        hint = "; a text needs quotes" if str(error).startswith("Invalid value") else ""
        raise LareError(f"task {task!r} is not valid TOML: {error}{hint}") from error
    like, teams = values.get("like"), values.get("teams")

    def other(name: Any) -> bool:
        return isinstance(name, str) and beside(task, name) not in (*seen, task)

    if not (like is None or other(like)):
        raise LareError(f"task {task!r}: like = {like!r} must be another task, without a cycle")
    if not (teams is None or (isinstance(teams, list) and all(map(other, teams)))):
        raise LareError(f"task {task!r}: teams = {teams!r} must be a list of other tasks, without a cycle")
    if "teams" in values:
        shared = {key: values[key] for key in OF_THE_ENVIRONMENT if key in values}
        values["teams"] = [shared | read_values(beside(task, team), (*seen, task)) for team in values["teams"]]
    parent = values.pop("like", None)
    return values if parent is None else read_values(beside(task, parent), (*seen, task)) | values


def beside(task: str, named: str) -> str:
    """A task that the file of `task` names. A path is relative to the folder of this file."""
    near = str(Path(task).parent / named)
    return near if task not in shipped_tasks() and is_file(near) else named


def is_file(name: str) -> bool:
    try:
        return Path(name).is_file()
    except (OSError, ValueError):  # too long, or with a character that no file name has
        return False


def the_role(spec: TaskSpec) -> TaskSpec:
    """The spec, if it describes a single role. Raises `LareError` if its teams have their own specs."""
    if spec.teams:
        names = ", ".join(role.name for role in spec.roles)
        raise LareError(f"{spec.name} has a latent function for each of its teams: name one of {names} instead")
    return spec


def check_against_environment(spec: TaskSpec) -> None:
    """Make the environment and compare it with the spec. Raises `LareError` at the first mismatch."""
    from lare.tasks.table import check_logs, env_spec  # imported here, because `table` imports this module

    if spec.environment == NO_ENVIRONMENT:
        check_logs(spec)
    else:
        env_spec(spec)

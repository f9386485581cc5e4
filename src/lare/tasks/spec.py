"""A task: an environment and the texts that describe it, read from TOML and checked against the environment."""

import hashlib
import json
import os.path
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, field_validator, model_validator

from lare.errors import Checked, LareError, did_you_mean, shortened
from lare.foreign import LARGEST_SETTINGS, read_text, read_toml

Judges = Literal["before", "after", "both"]
"""Which observation `phi` judges a step by: that before the action, that which the action led to, or both, one after
the other with their factors put side by side."""

JudgedFrom = Literal["observation", "state"]
"""What a step is judged by: each agent's own observation and action, or the global state and all actions side by side."""

SHIPPED = files("lare.tasks") / "specs"

PETTINGZOO = "pettingzoo/"
"""What the environment of a spec begins with where it is a PettingZoo environment; the rest is MODULE:NAME."""

OF_THE_ENVIRONMENT = ("environment", "arguments", "max_episode_steps", "judged_from", "judges")
"""Keys that a team has from its task. Its own spec may say them too, to be used alone, but nothing else."""

NO_ENVIRONMENT = "none"
"""Stands for the environment in a spec of logs, whose environment is not at hand."""

FILL_IN = "FILL IN"
"""Stands in a new spec where nobody has said something yet."""


class TaskSpec(Checked):
    """What is to be solved."""

    model_config = ConfigDict(str_strip_whitespace=True)

    name: Annotated[str, Field(min_length=1, pattern=r"^[\w.\-]+$")]
    """What the task is called, in commands and in the names of runs."""
    environment: Annotated[str, Field(min_length=1)]
    """Gymnasium id, where `module:id` imports the module that registers it first; or the name of another family's environment,
    as `particles/CN-6`; or `none`, where there are logs only: functions are designed and logs relabelled, and nothing trains."""
    observation_size: Annotated[int, Field(ge=1)]
    action_size: Annotated[int, Field(ge=1)]
    judges: Judges = "after"
    description: Annotated[str, Field(min_length=1)]
    """The task and its goal, without a word about the reward."""
    observation: Annotated[str, Field(min_length=1)]
    """What each entry of the observation means."""
    action: Annotated[str, Field(min_length=1)]
    """What each entry of the action means."""
    max_episode_steps: Annotated[int | None, Field(ge=1)] = None
    """Time limit, for an environment that has none of its own; or of the episodes of logs."""
    score: Literal["sum", "average"] | None = None
    """Whether what an episode returns is a sum over its steps, or an average or a mark, which does not grow with them. Where the
    task does not say, training finds out which predicts returns better."""
    measures: tuple[str, ...] = ()
    """Keys of the last step's `info` that are averaged and reported beside the return."""
    arguments: dict[str, Any] = Field(default_factory=dict)
    """Keyword arguments of the environment, where it is made from a module (`pettingzoo/...`); refused elsewhere."""
    agents: tuple[str, ...] = ()
    """Names, or patterns of names like `prey_*`, of the agents that this spec speaks of; all of them, unless given. Only where
    agents have names (`pettingzoo/...`)."""
    judged_from: JudgedFrom = "observation"
    """Whether `phi` judges each agent's step by what the agent observes, or the whole team's by the global state."""
    teams: tuple["TaskSpec", ...] = ()
    """Where several teams learn, each for itself: a spec for each, with texts of its own. In TOML, their names."""
    team: str | None = None
    """The team that this spec speaks of, where it is one of several of its environment."""

    @field_validator("arguments")
    @classmethod
    def can_be_kept(cls, arguments: dict[str, Any]) -> dict[str, Any]:
        try:
            json.dumps(arguments, allow_nan=False)  # as a run keeps its task, and would come back with something else
        except (TypeError, ValueError):
            raise ValueError("a run cannot keep dates, inf or nan: numbers, strings, lists and tables only") from None
        return arguments

    @model_validator(mode="after")
    def is_filled_in(self) -> "TaskSpec":
        for key in ("description", "observation", "action"):
            if FILL_IN in getattr(self, key):
                raise ValueError(f"{key} still says {FILL_IN!r}: say there what a language model must know")
        return self

    @model_validator(mode="after")
    def has_teams_of_its_environment(self) -> "TaskSpec":
        for role in self.teams:
            if role.environment != self.environment or role.team is None:
                raise ValueError(
                    f"{role.name} is no team of {self.environment}: it needs the same environment, and a team"
                )
        return self

    @property
    def family(self) -> str:
        """What stands before the first slash of the environment: see `table.py`."""
        return self.environment.partition("/")[0] if "/" in self.environment else ""

    @property
    def environment_name(self) -> str:
        """What stands behind it."""
        return self.environment.partition("/")[2]

    @property
    def roles(self) -> tuple["TaskSpec", ...]:
        """The specs that latent functions are designed for: those of the teams, or this one."""
        return self.teams or (self,)

    @property
    def digest(self) -> str:
        """SHA-256 of everything that the spec says."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


def shipped_tasks() -> list[str]:
    """Names of the tasks that come with the package."""
    return sorted(entry.name.removesuffix(".toml") for entry in SHIPPED.iterdir() if entry.name.endswith(".toml"))


def as_task(given: TaskSpec | str | Path, playable: bool = True) -> TaskSpec:
    """A task by itself, by its shipped name, or by the path of its file.

    Args:
        given: one of these.
        playable: whether its environment must be there, and be as the task says.

    Raises:
        LareError: it is none of these; and as `load_task`.
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
        LareError: there is no such task, the file is not a spec, or the environment is not what the spec says.

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
    """The keys of a spec, those of the spec that it is `like` filled in."""
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
    except ValueError as error:  # TOMLDecodeError is one; a number without end is another
        raise LareError(f"task {task!r} is not valid TOML: {error}") from error
    like, teams = values.get("like"), values.get("teams")

    def other(name: Any) -> bool:
        return isinstance(name, str) and beside(task, name) not in (*seen, task)

    if not (like is None or other(like)):
        raise LareError(f"task {task!r}: like = {like!r} must be another task, without a circle")
    if not (teams is None or (isinstance(teams, list) and all(map(other, teams)))):
        raise LareError(f"task {task!r}: teams = {teams!r} must be a list of other tasks, without a circle")
    if "teams" in values:
        shared = {key: values[key] for key in OF_THE_ENVIRONMENT if key in values}
        values["teams"] = [shared | read_values(beside(task, team), (*seen, task)) for team in values["teams"]]
    parent = values.pop("like", None)
    return values if parent is None else read_values(beside(task, parent), (*seen, task)) | values


def beside(task: str, named: str) -> str:
    """A task that another one names. A path is meant from the folder of the file that it stands in."""
    near = str(Path(task).parent / named)
    return near if task not in shipped_tasks() and is_file(near) else named


def is_file(name: str) -> bool:
    try:
        return Path(name).is_file()
    except (OSError, ValueError):  # too long, or with a character that no file name has
        return False


def the_role(spec: TaskSpec) -> TaskSpec:
    """The spec, if it speaks of one role. Raises `LareError` where teams have specs of their own."""
    if spec.teams:
        names = ", ".join(role.name for role in spec.roles)
        raise LareError(f"{spec.name} has a latent function for each of its teams: name one of {names} instead")
    return spec


def check_against_environment(spec: TaskSpec) -> None:
    """Make the environment once and compare. Raises `LareError` at the first thing that does not fit."""
    from lare.tasks.table import check_logs, env_spec  # which knows all families, as this file need not

    if spec.environment == NO_ENVIRONMENT:
        check_logs(spec)
    else:
        env_spec(spec)

"""The settings of a run: `Settings`, as a user gives them, and `ResolvedSettings`, in which every value is decided."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Generic, Literal, Never, TypeVar

from pydantic import ConfigDict, Field, SerializeAsAny, create_model, field_validator, model_validator

from lare_rl.algorithms.registry import ALGORITHMS, AlgorithmSettings
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.errors import CheckedModel, Count
from lare_rl.llm.prompts import N_CANDIDATES
from lare_rl.tasks.spec import ScoredObservation, TaskSpec
from lare_rl.util.rounding import round_up

__all__ = ["ResolvedSettings", "Settings"]

MAX_STEPS = 2**30
"""Steps and rows of the replay are counted in int32, and an episode of one step takes two rows."""
LARGEST_SEED = 2**31 - 1
MAX_N_SEEDS = 1000
"""In one process."""

Undecided = TypeVar("Undecided")
"""The type of a value that is not decided yet: None in `Settings`, and Never in `ResolvedSettings`."""
UNDECIDED: Any = None
"""The default of a setting that may be undecided. `Any`, because `ResolvedSettings` does not accept it."""


class _RunSettings(CheckedModel, Generic[Undecided]):
    method: str | Undecided = UNDECIDED
    """How credit is assigned (`lare-rl methods`). By default lare-bayes; with qmix and vdn lare-rd."""
    algorithm: str | Undecided = UNDECIDED
    """What trains the policy (`lare-rl algorithms`). By default, for one agent, ppo with discrete actions, else td3; for many,
    qmix for one team with a global state and action masks, else ippo."""
    steps: Annotated[int, Field(ge=1, le=MAX_STEPS)] | Undecided = UNDECIDED
    """Environment steps of each seed; all agents act in one step. By default about 1,000,000 for one agent, and about
    2,000,000 for many."""
    seeds: Count = 1
    """Number of seeds, trained in lockstep."""
    seed: Annotated[int, Field(ge=0)] = 0
    """The first seed; the others follow it."""
    scored_observation: ScoredObservation | None = None
    """Replaces the task's key of this name: the observations that factors and raw features are computed from."""
    draw: Annotated[int, Field(ge=0)] = 0
    """The number of the recorded design that phi comes from: 0, or up to 4 for tasks that have five; independent of the seed."""
    candidates: Count = N_CANDIDATES
    """Candidates that are combined into phi; with 1, nothing is combined. There are recorded replies for 1 and for 5."""
    environments: Count | Undecided = UNDECIDED
    """Copies of the environment for each seed; several on the host run in worker processes. By default 1; in JAX 82 for
    ippo, and 8 for qmix and vdn."""
    rollout_steps: Count | Undecided = UNDECIDED
    """Steps of each copy in an iteration (collect, store, fit, update). By default 50. For ppo, all copies together have 2000,
    rounded to episodes of the maximum length. For ippo, a copy has one episode if all episodes are equally long; else all copies
    together have 2050 in JAX, and 2000 on the host. For ppo and ippo at least 16, unless rounded to whole episodes."""
    fit_every: Count | Undecided = UNDECIDED
    """Iterations between two fits of the decoder, for ppo and ippo, and for methods with a loss of their own (diaster, rudder, grd,
    rbt). By default 10 for ippo, else 1."""
    fit_updates: Count | Undecided = UNDECIDED
    """Gradient steps in each of these fits. By default 500 for ppo and 50 for ippo. For methods with a loss of their own, one for
    every 50 environment steps."""
    first_fit: Literal["held-out", "published"] | None = None
    """For ippo: the first fit lasts until the held-out error stops falling (held-out, the default), or for fit_updates
    (published)."""
    evaluate_every: Count | Undecided = UNDECIDED
    """Environment steps between two evaluations; one also follows the last step. By default 5000 for td3, ddpg and sac, about
    10,000 for qmix and vdn, about 20,000 for ippo, and 5 iterations for ppo. A short run of ippo or ppo is evaluated more often,
    so that it has 5 evaluations."""
    evaluation_episodes: Count | Undecided = UNDECIDED
    """Episodes in one evaluation. By default 10; in JAX 50 for ippo, and 32 for qmix and vdn."""
    capacity: Count | Undecided = UNDECIDED
    """Rows in a seed's replay; an episode of T steps takes T + 1. By default 1,000,000; 15,000 of the longest episodes for
    ippo, and 5000 for qmix and vdn."""
    scale_rewards: bool = False
    """Divide rewards by the running root mean square of R/T. No effect with ppo and ippo."""
    overlap_collection: bool = False
    """Collect the next steps while the device updates: faster on an accelerator, with a policy one iteration older. For algorithms
    that consume transitions, in an environment on the host."""
    credit: CreditSettings | Undecided = UNDECIDED
    """How the decoder is fitted. The algorithm decides each of these settings that is not given."""

    @field_validator("method", "algorithm")
    @classmethod
    def _check_name(cls, name: Any, info: Any) -> Any:
        if name is not None:
            {"method": METHODS, "algorithm": ALGORITHMS}[info.field_name].find(name)
        return name

    @model_validator(mode="after")
    def _check_seeds(self) -> "_RunSettings":
        if self.seeds > MAX_N_SEEDS:
            raise ValueError(f"seeds = {self.seeds}: at most {MAX_N_SEEDS} train in one process")
        if self.seed + self.seeds - 1 > LARGEST_SEED:
            raise ValueError(f"seed = {self.seed} with seeds = {self.seeds}: the largest seed is {LARGEST_SEED}")
        return self


_HYPERPARAMETERS: dict[str, Any] = {
    name: (type(algorithm.settings), algorithm.settings) for name, algorithm in ALGORITHMS.items()
}
"""The class and the published values of each algorithm's hyperparameters: the type and the default of a field."""


class Settings(create_model("_AlgorithmFields", __base__=_RunSettings[None], __module__=__name__, **_HYPERPARAMETERS)):
    """The settings of `lare-rl train` and `lare_rl.train`. If a setting is None, the task and the algorithm decide it.

    The hyperparameters of an algorithm have its name: `Settings(td3={"gamma": 0.98})` changes one, and keeps the others as published.
    """

    if TYPE_CHECKING:  # plugins add fields, which type checkers cannot know

        def __init__(self, **values: Any) -> None: ...

    @model_validator(mode="before")
    @classmethod
    def _complete_hyperparameters(cls, values: Any) -> Any:
        """Fill in the hyperparameters that are not given with those of the algorithm: names such as td3 and ddpg share a class."""
        if not isinstance(values, Mapping):
            return values
        completed = dict(values)
        for name in values.keys() & _HYPERPARAMETERS.keys():
            kind, default = _HYPERPARAMETERS[name]
            changes = values[name]
            if isinstance(changes, kind):
                changes = changes.model_dump(exclude_unset=True)
            if isinstance(changes, Mapping):
                completed[name] = {**dict(default), **changes}
        return completed


class ResolvedSettings(_RunSettings[Never]):
    """The settings of a run, all of them decided.

    Two values may be None: `scored_observation` (the task decides) and `first_fit` (the run does not use it).
    """

    model_config = ConfigDict(validate_default=True)  # a value that is missing is an error

    hyperparameters: SerializeAsAny[AlgorithmSettings]
    """The hyperparameters of the algorithm."""

    @field_validator("hyperparameters", mode="before")
    @classmethod
    def _read_hyperparameters(cls, values: Any, info: Any) -> Any:
        algorithm = info.data.get("algorithm")  # missing if it was not valid
        if algorithm is None or not isinstance(values, Mapping):
            return values
        default = ALGORITHMS[algorithm].settings  # several algorithms share its class
        return type(default).model_validate({**dict(default), **values})

    @model_validator(mode="after")
    def _check_multiples(self) -> "ResolvedSettings":
        for name in ("steps", "evaluate_every"):
            if getattr(self, name) % self.iteration_steps:
                raise ValueError(
                    f"{name} = {getattr(self, name)} is not a multiple of an iteration's {self.iteration_steps} steps"
                )
        return self

    @property
    def all_seeds(self) -> list[int]:
        return list(range(self.seed, self.seed + self.seeds))

    @property
    def iteration_steps(self) -> int:
        """Environment steps of a seed in an iteration."""
        return self.environments * self.rollout_steps

    @property
    def warmup(self) -> int:
        """Steps of random actions before the first update: whole iterations."""
        return round_up(getattr(self.hyperparameters, "warmup", 0), self.iteration_steps)

    def choose_scored_observation(self, task: TaskSpec) -> ScoredObservation:
        """Return which observations of a step factors and raw features are computed from."""
        return self.scored_observation or task.scored_observation

"""The settings of a run: as a user gives them, and with every open value decided."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, create_model, field_validator, model_validator
from pydantic.fields import FieldInfo

from lare_rl.algorithms.settings import PPOSettings, QMIXSettings, SACSettings, TD3Settings
from lare_rl.algorithms.table import ALGORITHMS, DDPG, IPPO, PPO, VDN, AlgorithmSettings, Consumes, Name
from lare_rl.credit.decoder_settings import RECENT, CreditSettings
from lare_rl.credit.methods import find_method
from lare_rl.errors import Checked
from lare_rl.latent.candidates import CANDIDATES
from lare_rl.tasks.spec import Judges, TaskSpec

LARGEST_SEED = 2**31 - 1

MOST_SEEDS = 1000
"""The most seeds in one process."""


def kind_of(field: FieldInfo) -> Any:
    """The type of a field, with its bounds."""
    return Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation


def optional(field: FieldInfo) -> tuple[Any, Any]:
    """A field that may also be None, which is its default."""
    return kind_of(field) | None, Field(None, description=field.description)


OPTIONS: dict[str, Any] = {name: optional(field) for name, field in CreditSettings.model_fields.items()}

if TYPE_CHECKING:
    CreditOptions = CreditSettings
else:
    CreditOptions = create_model("CreditOptions", __base__=Checked, __module__=__name__, **OPTIONS)
    CreditOptions.__doc__ = "How the decoder is fitted. The algorithm decides each setting that is not given."

Count = Annotated[int, Field(ge=1)]


class Settings(Checked):
    """The settings of `lare-rl train` and `lare_rl.train`. If a setting is None, the task and the algorithm decide it."""

    method: str | None = None
    """How credit is assigned (see `lare-rl methods`). By default lare-bayes, and lare-rd with qmix and vdn."""
    algorithm: Name | None = None
    """The reinforcement learning algorithm. By default, for a single agent: ppo if actions are discrete, else td3. For many agents:
    qmix if there are a global state and action masks, else ippo."""
    steps: Count | None = None
    """Environment steps of each seed (in one step, all agents act). By default 1,000,000 for a single agent, and about 2,000,000
    for many."""
    seeds: Count = 1
    """How many seeds to train, in lockstep in one process."""
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)] = 0
    """The first seed; the others are the numbers after it."""
    judges: Judges | None = None
    """By which observation a step is judged: the one before it, the one after it, or both. By default, as the task says."""
    draw: Annotated[int, Field(ge=0)] = 0
    """Which recorded reply of the language model to take phi from (0 to 4); independent of the seed."""
    candidates: Count = CANDIDATES
    """How many candidates phi is combined from; with 1, there is no self-prompting. The shipped recordings have 1 and 5."""
    environments: Count | None = None
    """Copies of the environment for each seed. By default 1 on the host, where several copies run in worker processes; in JAX, 82
    for ippo and 8 for qmix."""
    rollout_steps: Count | None = None
    """Steps of each copy in an iteration, which collects, stores, fits and updates. By default 50 for algorithms that consume
    transitions or sequences, and 2000 over all copies for ppo; for ippo an episode on particle tasks, and on other tasks 2050 over
    all copies in JAX, 2000 on the host."""
    fit_every: Count | None = None
    """For ppo and ippo, and for every algorithm with diaster: iterations between two fits of the decoder. By default 10 for ippo,
    else 1."""
    fit_updates: Count | None = None
    """For the same algorithms: gradient steps of the decoder in each fit. By default 500 for ppo and 50 for ippo; with diaster, one
    for every 50 environment steps."""
    first_fit: Literal["held-out", "published"] | None = None
    """For ippo: how long the decoder's first fit lasts. held-out (the default): until the error on held-out episodes stops falling.
    published: fit_updates, as in every later fit."""
    evaluate_every: Count | None = None
    """Environment steps between two evaluations; the last step is followed by one, too. A checkpoint is written at each. By default
    5000 for td3, ddpg and sac, about 10,000 for qmix, 10 iterations for ippo, and 5 iterations for ppo."""
    evaluation_episodes: Count | None = None
    """Episodes in one evaluation. By default 10; in JAX, 50 for ippo and 32 for qmix."""
    reflect_every: Count | None = None
    """For lare-bayes: environment steps between two reflections. In each, a language model sees how well its function explains the
    stored returns, and a new function that explains them better replaces the old one. By default there are no reflections."""
    capacity: Annotated[int, Field(ge=4)] | None = None
    """Rows in the replay of a seed; an episode of T steps takes T + 1. By default 1,000,000; 15,000 of the longest episodes for
    ippo, and 5000 for qmix."""
    scale_rewards: bool = False
    """Divide the rewards that the algorithm sees by the running root mean square of R/T. It changes nothing for ppo and ippo."""
    td3: TD3Settings = TD3Settings()
    ddpg: TD3Settings = DDPG
    sac: SACSettings = SACSettings()
    ppo: PPOSettings = PPO
    ippo: PPOSettings = IPPO
    qmix: QMIXSettings = QMIXSettings()
    vdn: QMIXSettings = VDN
    credit: CreditOptions = CreditOptions()

    @field_validator("method")
    @classmethod
    def known_method(cls, method: str | None) -> str | None:
        return None if method is None else find_method(method).name

    @field_validator("credit", mode="before")
    @classmethod
    def options(cls, credit: Any) -> Any:
        """Of a `CreditSettings`, take only the values that were set."""
        return credit.model_dump(include=credit.model_fields_set) if isinstance(credit, CreditSettings) else credit

    @model_validator(mode="after")
    def seeds_that_there_are(self) -> "Settings":
        if self.seeds > MOST_SEEDS:
            raise ValueError(f"seeds = {self.seeds}: at most {MOST_SEEDS} train in one process")
        if self.seed + self.seeds - 1 > LARGEST_SEED:
            raise ValueError(f"seed = {self.seed} with seeds = {self.seeds}: the largest seed is {LARGEST_SEED}")
        return self


class ResolvedSettings(Checked):
    """The settings that a run uses, with every open value decided. The names are those of `Settings`."""

    method: str
    algorithm: Name
    steps: Count
    seeds: Annotated[int, Field(ge=1, le=MOST_SEEDS)]
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)]
    judges: Judges | None
    draw: Annotated[int, Field(ge=0)]
    candidates: Count
    environments: Count
    rollout_steps: Count
    fit_every: Count
    fit_updates: Count
    evaluate_every: Count
    evaluation_episodes: Count
    capacity: Annotated[int, Field(ge=4)]
    scale_rewards: bool
    reflect_every: Count | None = None
    first_fit: Literal["held-out", "published"] | None = "published"
    """None where it makes no difference. The default is for config.json files that are older than the setting."""
    hyperparameters: AlgorithmSettings
    """The hyperparameters of the algorithm."""
    credit: CreditSettings

    @model_validator(mode="before")
    @classmethod
    def hyperparameters_of_the_algorithm(cls, values: Any) -> Any:
        """Read them as those of the named algorithm, because other algorithms may have the same keys."""
        given = values.get("hyperparameters") if isinstance(values, Mapping) else None
        if not isinstance(given, Mapping) or values.get("algorithm") not in ALGORITHMS:
            return values
        kind = type(ALGORITHMS[values["algorithm"]].settings)
        return {**values, "hyperparameters": kind(**given)}

    @model_validator(mode="after")
    def whole_iterations(self) -> "ResolvedSettings":
        asked = {"steps": self.steps, "evaluate_every": self.evaluate_every, "reflect_every": self.reflect_every}
        for name, steps in asked.items():
            if steps is not None and steps % self.iteration_steps:
                near = max(1, round(steps / self.iteration_steps)) * self.iteration_steps
                raise ValueError(f"{name} = {steps} is not a multiple of {self.described_iteration}: take {near}")
        return self

    @property
    def all_seeds(self) -> list[int]:
        return [self.seed + i for i in range(self.seeds)]

    @property
    def iteration_steps(self) -> int:
        """Environment steps of a seed in an iteration."""
        return self.environments * self.rollout_steps

    @property
    def described_iteration(self) -> str:
        """The steps of an iteration, for a message."""
        if self.environments == 1:
            return f"rollout_steps = {self.rollout_steps}"
        return f"{self.iteration_steps} (rollout_steps = {self.rollout_steps} of environments = {self.environments})"

    @property
    def warmup(self) -> int:
        """Steps of random actions before the first update."""
        return getattr(self.hyperparameters, "warmup", 0)

    @property
    def untrained(self) -> str | None:
        """A warning if all steps are random, so that the policy is never updated."""
        if self.warmup < self.steps:
            return None
        warmup = f"{self.algorithm}.warmup"
        return (
            f"all {self.steps:,} steps are random, and the policy is not trained: {warmup} is {self.warmup:,}; take more steps or "
            f"a smaller {warmup}"
        )

    @property
    def rereads(self) -> bool:
        """Whether steps are read again after the policy has learned from them."""
        return ALGORITHMS[self.algorithm].consumes is not Consumes.ROLLOUTS or find_method(self.method).fit is not None

    def judged_by(self, task: TaskSpec) -> Judges:
        """By which observation a step is judged."""
        return self.judges or task.judges

    def rows(self, longest: int) -> int:
        """The number of rows of each environment, if an episode has up to `longest` steps."""
        from lare_rl.data.replay import (
            room,  # imported here, so that the command line does not import JAX with this file
        )

        needed = room(self.rollout_steps, longest)
        wanted = self.capacity // self.environments if self.rereads else needed + RECENT // self.environments
        return min(wanted, max(needed, 2 * self.steps // self.environments + 2))

    def in_force(self, task: TaskSpec) -> dict[str, Any]:
        """All settings that make a difference to the run, by dotted names as on the command line."""
        values = self.model_dump()
        if self.judges is None:
            values["judges"] = "as the task says"
        values[self.algorithm] = values.pop("hyperparameters")
        return {name: value for name, value in dotted(values) if not among(name, self.idle)}

    @property
    def idle(self) -> list[str]:
        """Settings that make no difference to this algorithm and method, by dotted names."""
        method, consumes = find_method(self.method), ALGORITHMS[self.algorithm].consumes
        found = [f"credit.{name}" for name in CreditSettings.model_fields if name not in method.settings]
        apart = method.fit is not None and method.fit.apart
        if not method.descends or (consumes is not Consumes.ROLLOUTS and not apart):
            found += ["fit_every", "fit_updates"]
        if not (method.descends and consumes is Consumes.ROLLOUTS and ALGORITHMS[self.algorithm].many_agents):
            found.append("first_fit")
        if not method.follows_judges:
            found.append("judges")
        if not method.latent:
            found += ["draw", "candidates"]
        if self.reflect_every is None:
            found.append("reflect_every")
        if not self.rereads:
            found.append("capacity")
        if consumes is Consumes.ROLLOUTS:
            found.append("scale_rewards")
        if isinstance(self.hyperparameters, TD3Settings) and not self.hyperparameters.policy_noise:
            found.append(f"{self.algorithm}.noise_clip")
        return found


def set_in_vain(settings: Settings, resolved: ResolvedSettings, task: TaskSpec) -> dict[str, str]:
    """Messages, by dotted names, about settings that were set but make no difference to this task, algorithm and method."""
    usual, found = dict(dotted(Settings().model_dump())), {}
    known = resolved.in_force(task)
    others = [name for name in ALGORITHMS if name != resolved.algorithm]
    for name, value in dotted(settings.model_dump()):
        if value == usual[name]:
            continue
        if among(name, others):
            instead = f"{resolved.algorithm}.{name.rpartition('.')[2]}"
            hint = f"; it has {instead}" if instead in known else ""
            found[name] = f"{name} makes no difference to {resolved.algorithm} on {task.name}{hint}"
        elif among(name, resolved.idle):
            by_algorithm = name in ("scale_rewards", f"{resolved.algorithm}.noise_clip")
            whom = f"{resolved.algorithm} on {task.name}" if by_algorithm else resolved.method
            found[name] = f"{name} makes no difference to {whom}"
    return found


def among(name: str, groups: list[str]) -> bool:
    """Whether a dotted name is one of these groups, or lies in one of them."""
    return any(f"{name}.".startswith(f"{group}.") for group in groups)


def dotted(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Nested settings, flattened: dotted names and values."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from dotted(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value

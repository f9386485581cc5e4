"""Every setting of a run. Together with the task and the latent functions they say all that a run depends on."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

from pydantic import Field, field_validator, model_validator

from lare.algorithms.ppo import PPOSettings
from lare.algorithms.sac import SACSettings
from lare.algorithms.table import ALGORITHMS, DDPG, IPPO, PPO, AlgorithmSettings, Kind, Name
from lare.algorithms.td3 import TD3Settings
from lare.credit.accuracy import RECENT
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import Decoder, Reward, find_method
from lare.errors import Checked, LareError
from lare.latent.design import CANDIDATES
from lare.tasks.particles.task import STEPS
from lare.tasks.spec import Judges, TaskSpec, is_discrete

LARGEST_SEED = 2**31 - 1


class AgentSettings(Checked):
    """What is particular to many agents. The numbers are the published code's, but for VIB's divergence."""

    episodes: Annotated[int, Field(ge=1)] = 82
    """Episodes that are played between two updates of the policy."""
    fit_every: Annotated[int, Field(ge=1)] = 10
    """Updates of the policy for each time that the decoder is fitted."""
    fit_updates: Annotated[int, Field(ge=1)] = 50
    """Gradient steps of the decoder then."""
    capacity: Annotated[int, Field(ge=1)] = 15_000
    """Episodes that the replay of a seed holds, for the decoder."""
    credit: CreditSettings = CreditSettings(
        hidden=(64, 64, 64, 64),
        learning_rate=5e-4,
        weight_decay=1e-5,
        drawn_steps=10,
        steps=6400,
        encoder=(256,),
        bottleneck=4,
        divergence=1e-3,
    )


class RolloutSettings(Checked):
    """What ppo does between two updates of the policy of a single agent."""

    steps: Annotated[int, Field(ge=1)] = 2000
    """Environment steps that are collected."""
    fit_updates: Annotated[int, Field(ge=1)] = 500
    """Gradient steps of the decoder; diaster's, which cost far more, are as many as `credit.fits` says."""


class Settings(Checked):
    """What `lare train` and `lare.train` are given. What is None is decided by the task and the algorithm."""

    method: str | None = None
    """How credit is assigned (see `lare methods`); lare-rrdu for a single agent, lare-rd for many, unless given."""
    algorithm: Name | None = None
    """The reinforcement learning algorithm: ippo for tasks of many agents, ppo for one that chooses among
    actions, td3 for all others."""
    steps: Annotated[int | None, Field(ge=1)] = None
    """Environment steps of each seed (all agents act in one): 1,000,000 for a single agent, 2,050,000 for ippo."""
    seeds: Annotated[int, Field(ge=1)] = 1
    """How many seeds to train, in lockstep in one process."""
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)] = 0
    """The first seed; the others follow it."""
    judges: Judges | None = None
    """Which observation the factors judge a step by; what the task says, unless given."""
    draw: Annotated[int, Field(ge=0)] = 0
    """Which recorded reply of the language model to take phi from (0 to 4); independent of the seed."""
    candidates: Annotated[int, Field(ge=1)] = CANDIDATES
    """How many candidates phi is made of; 1: without self-prompting. The shipped recordings hold 1 and 5."""
    chunk: Annotated[int, Field(ge=1)] = 50
    """Off-policy: environment steps, and then as many updates, between two calls of the compiled training step.
    ppo with diaster: only what `credit.fits` says of it."""
    evaluate_every: Annotated[int | None, Field(ge=1)] = None
    """Environment steps between two evaluations; a checkpoint is written at each: 5000 off-policy, 10 updates for
    ippo, 5 for ppo."""
    evaluation_episodes: Annotated[int | None, Field(ge=1)] = None
    """Episodes in one evaluation: 10 for a single agent, 50 for ippo."""
    capacity: Annotated[int, Field(ge=4)] = 1_000_000
    """Single agents: observations that the replay of a seed holds; an episode of T steps takes T + 1."""
    scale_rewards: bool = False
    """TD3, DDPG, SAC: divide the rewards that the algorithm sees by the running root mean square of R/T."""
    td3: TD3Settings = TD3Settings()
    ddpg: TD3Settings = DDPG
    sac: SACSettings = SACSettings()
    ppo: PPOSettings = PPO
    rollout: RolloutSettings = RolloutSettings()
    credit: CreditSettings = CreditSettings()
    ippo: PPOSettings = IPPO
    agents: AgentSettings = AgentSettings()

    @field_validator("method")
    @classmethod
    def known_method(cls, method: str | None) -> str | None:
        return None if method is None else find_method(method).name

    @model_validator(mode="after")
    def seeds_that_there_are(self) -> "Settings":
        if self.seed + self.seeds - 1 > LARGEST_SEED:
            raise ValueError(f"seed = {self.seed} and {self.seeds - 1} that follow it: the largest is {LARGEST_SEED}")
        return self

    @property
    def all_seeds(self) -> list[int]:
        return [self.seed + i for i in range(self.seeds)]


class Plan(Settings):
    """Settings with everything decided: what a run goes by. Narrower than what was given; and frozen, so that is sound."""

    method: str = "lare-rrdu"  # pyright: ignore[reportIncompatibleVariableOverride]
    algorithm: Name = "td3"  # pyright: ignore[reportIncompatibleVariableOverride]
    steps: int = 1_000_000  # pyright: ignore[reportIncompatibleVariableOverride]
    evaluate_every: int = 5000  # pyright: ignore[reportIncompatibleVariableOverride]
    evaluation_episodes: int = 10  # pyright: ignore[reportIncompatibleVariableOverride]

    @model_validator(mode="after")
    def whole_chunks(self) -> "Plan":
        for name, steps in (
            ("steps", self.steps),
            ("evaluate_every", self.evaluate_every),
            (f"{self.algorithm}.warmup", self.warmup),
        ):
            if steps % self.turn:
                near = max(1, round(steps / self.turn)) * self.turn
                raise ValueError(f"{name} = {steps} is not a multiple of {self.what_a_turn_is}: take {near}")
        return self

    @property
    def warmup(self) -> int:
        """Steps of random actions before the first update."""
        return getattr(self.of_algorithm, "warmup", 0)

    @property
    def turn(self) -> int:
        """Environment steps of a seed between two calls of the compiled training step."""
        match ALGORITHMS[self.algorithm].kind:
            case Kind.OFF_POLICY:
                return self.chunk
            case Kind.ON_POLICY:
                return self.rollout.steps
            case Kind.MANY_AGENTS:
                return self.agents.episodes * STEPS

    @property
    def what_a_turn_is(self) -> str:
        match ALGORITHMS[self.algorithm].kind:
            case Kind.OFF_POLICY:
                return f"chunk = {self.chunk}"
            case Kind.ON_POLICY:
                return f"rollout.steps = {self.rollout.steps}"
            case Kind.MANY_AGENTS:
                return f"{self.turn} (agents.episodes = {self.agents.episodes}, of {STEPS} steps each)"

    @property
    def of_algorithm(self) -> AlgorithmSettings:
        """The hyperparameters of the algorithm."""
        return getattr(self, self.algorithm)

    @property
    def apart(self) -> bool:
        """Whether the decoder is too expensive to be fitted often: `credit.fits` times for each `chunk` of steps."""
        fit = find_method(self.method).fit
        return fit is not None and fit.apart

    @property
    def fit_updates(self) -> int:
        """ppo: gradient steps of the decoder before each update of the policy."""
        return max(1, self.credit.fits * self.rollout.steps // self.chunk) if self.apart else self.rollout.fit_updates

    @property
    def rereads(self) -> bool:
        """Whether steps are read again when the policy has learned from them."""
        method = find_method(self.method)
        match ALGORITHMS[self.algorithm].kind:
            case Kind.OFF_POLICY:
                return True
            case Kind.ON_POLICY:
                return method.descends
            case Kind.MANY_AGENTS:
                return method.descends or method.reward is Reward.UNIFORM

    @property
    def idle(self) -> tuple[str, ...]:
        """Settings, and groups of them, that make no difference to this algorithm, by dotted names."""
        others = tuple(name for name in ALGORITHMS if name != self.algorithm)
        match ALGORITHMS[self.algorithm].kind:
            case Kind.OFF_POLICY:
                unclipped = isinstance(self.of_algorithm, TD3Settings) and not self.of_algorithm.policy_noise
                return (*others, "rollout", "agents", *([f"{self.algorithm}.noise_clip"] if unclipped else []))
            case Kind.ON_POLICY:
                return (*others, "agents", "scale_rewards", *(("rollout.fit_updates",) if self.apart else ("chunk",)))
            case Kind.MANY_AGENTS:
                of_one = ("agents.credit.episodes", "agents.credit.fits")
                return (*others, "rollout", "credit", "chunk", "capacity", "scale_rewards", *of_one)

    @property
    def idle_for_method(self) -> tuple[str, ...]:
        """Settings that make no difference to this method."""
        method = find_method(self.method)
        credit = "agents.credit" if ALGORITHMS[self.algorithm].kind is Kind.MANY_AGENTS else "credit"
        found = [f"{credit}.{name}" for name in CreditSettings.model_fields if name not in method.settings]
        if not method.descends:
            found += ["agents.fit_every", "agents.fit_updates", "rollout.fit_updates"]
        if not method.latent:
            found += ["judges", "draw", "candidates"]
        if not self.rereads:
            found += ["capacity", "agents.capacity"]
        return tuple(found)

    def judged_by(self, task: TaskSpec) -> Judges:
        """Which observation the factors judge a step by."""
        return self.judges or task.judges

    def in_force(self, task: TaskSpec) -> dict[str, Any]:
        """All that matters here, by dotted names as on the command line."""
        named, idle = dict(dotted(self.model_dump())), self.idle + self.idle_for_method
        if self.judges in (None, task.judges):
            named["judges"] = "as the task says"
        return {name: value for name, value in named.items() if not among(name, idle)}

    @property
    def episodes(self) -> int:
        """Episodes of many agents to make room for: no more than are read again, and at least those of an update."""
        return min(self.agents.capacity, self.steps // STEPS) if self.rereads else self.agents.episodes

    def rows(self, longest: int) -> int:
        """Observations of a single agent to make room for, where an episode has up to `longest` steps: likewise."""
        room = self.capacity if self.rereads else self.rows_of_a_turn(longest) + RECENT
        return min(room, 2 * self.steps + 2)

    def rows_of_a_turn(self, longest: int) -> int:
        """The most observations that a turn can need, with the episode that was under way before it."""
        return 2 * self.turn + longest


def set_in_vain(plan: Plan, task: TaskSpec) -> dict[str, str]:
    """What was set and makes no difference to this task, algorithm and method: by its dotted name, what is to be said of it."""
    usual, known, found = dict(dotted(Settings().model_dump())), plan.in_force(task), {}
    for name, value in dotted(plan.model_dump()):
        if value == usual[name]:
            continue
        if among(name, plan.idle):
            instead = f"agents.{name}" if f"agents.{name}" in known else f"{plan.algorithm}.{name.rpartition('.')[2]}"
            hint = f"; it has {instead}" if instead in known else ""
            found[name] = f"{name} makes no difference to {plan.algorithm} on {task.name}{hint}"
        elif among(name, plan.idle_for_method):
            found[name] = f"{name} makes no difference to {plan.method}"
    return found


def among(name: str, groups: Sequence[str]) -> bool:
    """Whether a dotted name is one of these, or of what is in one of them."""
    return any(f"{name}.".startswith(f"{group}.") for group in groups)


def dotted(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Settings within settings, in a row."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from dotted(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def decide(settings: Settings, task: TaskSpec) -> Plan:
    """Fill in what was left open, by the task.

    Raises:
        LareError: method, algorithm and task do not go together, or the steps are no whole number of turns.
    """
    if task.whole is not None:
        raise LareError(f"{task.name} is one team of {task.whole}: train that")
    many = task.particles is not None
    discrete = not many and is_discrete(task)
    algorithm = settings.algorithm or ("ippo" if many else "ppo" if discrete else "td3")
    kind = ALGORITHMS[algorithm].kind
    if many != (kind is Kind.MANY_AGENTS):
        raise LareError(
            f"{algorithm} is for {'a single agent' if many else 'many agents'}, and {task.name} is a task "
            f"of {'many' if many else 'one'}"
        )
    if kind is Kind.OFF_POLICY and discrete:
        raise LareError(f"{algorithm} acts by numbers within bounds, and {task.name} offers a choice: ppo can choose")
    usual: dict[str, Any] = {"algorithm": algorithm}
    if kind is Kind.ON_POLICY:
        turn = settings.rollout.steps
        usual |= {"steps": max(1, 1_000_000 // turn) * turn, "evaluate_every": 5 * turn}
    if kind is Kind.MANY_AGENTS:
        turn = settings.agents.episodes * STEPS
        usual |= {"method": "lare-rd", "steps": 1000 * turn, "evaluate_every": 10 * turn, "evaluation_episodes": 50}
    given = {name: getattr(settings, name) for name in type(settings).model_fields}
    plan = Plan(**usual | {name: value for name, value in given.items() if value is not None})
    method = find_method(plan.method)
    if method.reward is Reward.DESIGNED and plan.judged_by(task) == "both":
        raise LareError(f"{method.name} is one reward a step: it judges the observation before or after, not both")
    if plan.scale_rewards and method.has_proxy and not method.in_units:
        raise LareError(
            f"scale_rewards divides by the size of returns, and the rewards of {method.name} are not in their unit"
        )
    if method.for_one_only and many:
        raise LareError(f"{method.name} assigns credit to a single agent, and {task.name} is a task of many")
    if method.for_many_only and not many:
        raise LareError(f"{method.name} assigns credit among agents, and {task.name} is a task of one")
    if not many:
        check_credit(plan)
    return plan


def check_credit(plan: Plan) -> None:
    """Raise `LareError` where a single agent's decoder cannot be what is asked for."""
    method, credit = find_method(plan.method), plan.credit
    if "drawn_steps" in method.settings and credit.steps < credit.drawn_steps:
        raise LareError(
            f"credit.steps = {credit.steps} is less than credit.drawn_steps = {credit.drawn_steps}, of one episode"
        )
    if method.decoder is Decoder.DIASTER and not credit.hidden:
        raise LareError(f"credit.hidden is empty, and {method.name} needs a hidden layer")

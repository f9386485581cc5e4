"""Every setting of a run. Together with the task and the latent function they say all that a run depends on."""

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from lare.algorithms.td3 import TD3Settings
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import find_method
from lare.errors import Checked
from lare.tasks.spec import Judges

LARGEST_SEED = 2**31 - 1


class Settings(Checked):
    """What `lare train` and `lare.train` are given."""

    method: str = "lare-rrdu"
    """How credit is assigned: dense, episodic, rd, rrd, rrdu, lare-rd or lare-rrdu."""
    algorithm: Literal["td3"] = "td3"
    """The reinforcement learning algorithm."""
    steps: Annotated[int, Field(ge=1)] = 1_000_000
    """Environment steps of each seed."""
    seeds: Annotated[int, Field(ge=1)] = 1
    """How many seeds to train, in lockstep in one process."""
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)] = 0
    """The first seed; the others follow it."""
    judges: Judges | None = None
    """Which observation the factors judge a step by; what the task says, unless given."""
    draw: Annotated[int, Field(ge=0)] = 0
    """Which recorded reply of the language model to take phi from (0 to 4); independent of the seed."""
    chunk: Annotated[int, Field(ge=1)] = 50
    """Environment steps, and then as many updates, between two calls of the compiled training step."""
    evaluate_every: Annotated[int, Field(ge=1)] = 5000
    """Environment steps between two evaluations; a checkpoint is written at each of them."""
    evaluation_episodes: Annotated[int, Field(ge=1)] = 10
    """Episodes of the deterministic policy in one evaluation."""
    capacity: Annotated[int, Field(ge=4)] = 1_000_000
    """Observations that the replay of a seed holds; an episode of T steps takes T + 1."""
    scale_rewards: bool = False
    """Divide the rewards that the algorithm sees by the running root mean square of R/T."""
    td3: TD3Settings = TD3Settings()
    credit: CreditSettings = CreditSettings()

    @field_validator("method")
    @classmethod
    def known_method(cls, method: str) -> str:
        return find_method(method).name

    @model_validator(mode="after")
    def whole_chunks(self) -> "Settings":
        for name, steps in (
            ("steps", self.steps),
            ("evaluate_every", self.evaluate_every),
            ("td3.warmup", self.td3.warmup),
        ):
            if steps % self.chunk:
                raise ValueError(f"{name} = {steps} is not a multiple of chunk = {self.chunk}")
        return self

    @property
    def all_seeds(self) -> list[int]:
        return [self.seed + i for i in range(self.seeds)]

    @property
    def rows(self) -> int:
        """Observations to make room for: no more than the run can fill."""
        return min(self.capacity, 2 * self.steps + 2)

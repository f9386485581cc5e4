"""Steps of some environments, as they are collected, on their way into the replay."""

from typing import NamedTuple

from jaxtyping import Bool, Float

from lare.tasks.env import Numbers, Timestep


class Trajectory(NamedTuple):
    """Steps that follow each other in each of some environments; an episode may go on from one trajectory to the next.

    `*lead` is the seeds' axis, or nothing within functions of one seed.
    """

    before: Timestep
    """What each step set out from: [*lead time envs ...]."""
    action: Float[Numbers, "*lead time envs agents action"]
    """What the policy chose: in [-1, 1], or a row with a single 1."""
    taken: Float[Numbers, "*lead time envs agents action"]
    """The same in the environment's units."""
    after: Timestep
    """What each step led to, also at the end of an episode."""

    @property
    def ended(self) -> Bool[Numbers, "*lead time envs"]:
        """Whether the step was the last of its episode: terminated, or out of time."""
        return self.after.terminated | self.after.truncated

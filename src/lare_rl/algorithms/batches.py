"""The data that the training loop hands to an update, by what the algorithm consumes, and the shapes that algorithms share.

Shapes are those of jaxtyping: each word is an axis, and `*batch` stands for any number of axes.
"""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float

__all__ = ["Action", "Available", "Metrics", "Observation", "PerStep", "Rollout", "Sequences", "Transitions"]

Observation = Float[Array, "*batch observation"]
Action = Float[Array, "*batch action"]
"""In [-1, 1], or a one-hot row. Means, logits and noise of an action have the same shape."""
Available = Bool[Array, "*batch action"] | None
"""Which choices are available. None: all of them, or actions are continuous."""
PerStep = Float[Array, "*batch"]
"""A number of each step, such as Q(s, a), V(s) or log pi(a | s)."""
Metrics = dict[str, Float[Array, "*seeds"]]


class Transitions(NamedTuple):
    """Single steps from the replay: `Consumes.TRANSITIONS`. Actions are continuous."""

    observation: Float[Array, "batch observation"]
    action: Float[Array, "batch action"]
    reward: Float[Array, " batch"]
    next_observation: Float[Array, "batch observation"]
    terminated: Float[Array, " batch"]
    """1 where the episode terminated. A time limit is not a termination: the target still bootstraps there."""


class Rollout(NamedTuple):
    """The newest steps of all environments: `Consumes.ROLLOUTS`. The axis `actors` has one entry per agent and environment."""

    observation: Float[Array, "time actors observation"]
    action: Float[Array, "time actors action"]
    reward: Float[Array, "time actors"]
    next_observation: Float[Array, "time actors observation"]
    terminated: Float[Array, "time actors"]
    """1 where the target must not bootstrap: the episode terminated, or the agent left. With gamma = 1 also at a time limit."""
    done: Float[Array, "time actors"]
    """1 at the last step of an episode, terminated or truncated, and at the last step of an agent that leaves."""
    available: Bool[Array, "time actors action"] | None = None
    """Which choices were available. None: all of them."""
    mask: Float[Array, "time actors"] | None = None
    """1 where the agent acted, 0 after it has left. None: all 1."""


class Sequences(NamedTuple):
    """Whole episodes, padded to one length: `Consumes.SEQUENCES`. `done` and `mask` must be 0 in the padding."""

    observation: Float[Array, "episodes steps+1 agents observation"]
    state: Float[Array, "episodes steps+1 state"]
    available: Bool[Array, "episodes steps+1 agents action"]
    action: Float[Array, "episodes steps agents action"]
    """One-hot rows."""
    reward: Float[Array, "episodes steps"]
    """The team's reward."""
    done: Float[Array, "episodes steps"]
    """1 at the last step of an episode, even if a time limit ended it."""
    mask: Float[Array, "episodes steps"]
    """1 on the steps of the episode."""

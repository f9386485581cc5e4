"""The hyperparameters of the algorithms; their published values for each row are in `table.py`.

They are apart from the equations, which need JAX: the command line reads these classes to write its help.
"""

from typing import Annotated

from pydantic import Field

from lare.errors import Checked


class OffPolicySettings(Checked):
    """The hyperparameters that these algorithms share; none of them depends on the task."""

    hidden: tuple[Annotated[int, Field(ge=1)], ...] = (256, 256)
    """Widths of the hidden layers of actor and critics."""
    critics: Annotated[int, Field(ge=1)] = 2
    """How many there are; the smallest of their values counts."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Adam's step size, for all that is learned."""
    batch_size: Annotated[int, Field(ge=1)] = 256
    """Transitions in one update."""
    gamma: Annotated[float, Field(ge=0, le=1)] = 0.99
    """Discount of a step."""
    tau: Annotated[float, Field(gt=0, le=1)] = 0.005
    """How far the targets move towards the networks at a time."""
    warmup: Annotated[int, Field(ge=0)] = 10_000
    """Environment steps with uniformly random actions before the first update."""


class TD3Settings(OffPolicySettings):
    """Hyperparameters, as the LaRe paper sets them. The targets move at each policy update."""

    policy_noise: Annotated[float, Field(ge=0)] = 0.2
    """Standard deviation of the noise on the target action, in units of the action bound."""
    noise_clip: Annotated[float, Field(ge=0)] = 0.5
    """Bound of that noise."""
    policy_delay: Annotated[int, Field(ge=1)] = 2
    """Critic updates for each update of actor and targets."""
    exploration_noise: Annotated[float, Field(ge=0)] = 0.1
    """Standard deviation of the noise on the actions that are taken, in units of the action bound."""


class SACSettings(OffPolicySettings):
    """Hyperparameters, as the LaRe paper sets them."""

    target_every: Annotated[int, Field(ge=1)] = 2
    """Updates from one move of the target critics to the next."""
    temperature: Annotated[float, Field(gt=0)] = 1.0
    """alpha at the start."""


class PPOSettings(Checked):
    """Hyperparameters of PPO."""

    hidden: tuple[Annotated[int, Field(ge=1)], ...] = (64, 64)
    """Widths of the hidden layers of actor and critic."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Adam's step size, for actor and critic."""
    gamma: Annotated[float, Field(ge=0, le=1)] = 0.99
    """Discount of a step."""
    gae_lambda: Annotated[float, Field(ge=0, le=1)] = 0.95
    """Of the generalised advantage estimates: 0 trusts the critic, 1 the rewards."""
    epochs: Annotated[int, Field(ge=1)] = 10
    """How often an update goes over its rollout."""
    minibatch_size: Annotated[int, Field(ge=1)] = 64
    """Steps of one agent in one gradient step."""
    clip: Annotated[float, Field(gt=0)] = 0.2
    """How far the probability ratio may move."""
    value_clip: Annotated[float, Field(gt=0)] = 0.5
    """How far the value may move in one update, in deviations of the return."""
    value_coef: Annotated[float, Field(ge=0)] = 0.5
    """Of the value loss beside the policy's."""
    entropy_coef: Annotated[float, Field(ge=0)] = 0.0
    """Of the policy's entropy beside its objective."""
    huber_delta: Annotated[float, Field(gt=0)] = 10.0
    """Where the value loss turns from square to linear, in deviations of the return."""
    max_grad_norm: Annotated[float, Field(gt=0)] = 0.5
    """What the gradient of actor and critic together is cut down to."""
    anneal: bool = False
    """Let learning rate and clip fall linearly to 0 over the run."""
    normalise_observations: bool = False
    """Let the networks see observations by their running mean and deviation."""


class QMIXSettings(Checked):
    """Hyperparameters, as PyMARL2 sets them for most maps of the StarCraft challenge."""

    hidden: Annotated[int, Field(ge=1)] = 64
    """Width of the agents' network and of its memory."""
    monotonic: bool = True
    """Mix the agents' values by a monotonic network; otherwise add them up, which is VDN."""
    embed: Annotated[int, Field(ge=1)] = 32
    """Width of the mixer."""
    hypernet: Annotated[int, Field(ge=1)] = 64
    """Width of the hidden layers of the networks that write the mixer's weights."""
    learning_rate: Annotated[float, Field(gt=0)] = 1e-3
    """Adam's step size, for all that is learned."""
    gamma: Annotated[float, Field(ge=0, le=1)] = 0.99
    """Discount of a step."""
    td_lambda: Annotated[float, Field(ge=0, le=1)] = 0.6
    """Of the targets: 0 trusts the target networks, 1 the rewards."""
    max_grad_norm: Annotated[float, Field(gt=0)] = 10.0
    """What the gradient of agents and mixer together is cut down to."""
    batch_size: Annotated[int, Field(ge=1)] = 128
    """Episodes in one update."""
    update_every: Annotated[int, Field(ge=1)] = 8
    """Episodes that are played for one update."""
    target_every: Annotated[int, Field(ge=1)] = 200
    """Episodes after which the targets are copied from the networks."""
    epsilon_start: Annotated[float, Field(ge=0, le=1)] = 1.0
    """How often an agent explores at first."""
    epsilon_end: Annotated[float, Field(ge=0, le=1)] = 0.05
    """How often it explores at last."""
    epsilon_steps: Annotated[int, Field(ge=1)] = 100_000
    """Environment steps over which that falls, linearly."""

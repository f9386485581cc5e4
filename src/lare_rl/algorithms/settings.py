"""The hyperparameters of the algorithms; their published values for each row are in `table.py`.

They are kept apart from the equations, which need JAX, because the command line reads these classes to write its help.
"""

from typing import Annotated

from pydantic import Field

from lare_rl.errors import Checked


class OffPolicySettings(Checked):
    """The hyperparameters that these algorithms share; none of them depends on the task."""

    hidden: tuple[Annotated[int, Field(ge=1)], ...] = (256, 256)
    """Widths of the hidden layers of actor and critics."""
    critics: Annotated[int, Field(ge=1)] = 2
    """Number of critics. The target uses the smallest of their values."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Learning rate of Adam, for all networks."""
    batch_size: Annotated[int, Field(ge=1)] = 256
    """Transitions in one update."""
    gamma: Annotated[float, Field(ge=0, le=1)] = 0.99
    """Discount factor."""
    tau: Annotated[float, Field(gt=0, le=1)] = 0.005
    """Fraction of the way that the target networks move towards the online networks at a time."""
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
    """Number of updates between two moves of the target critics."""
    temperature: Annotated[float, Field(gt=0)] = 1.0
    """Temperature alpha at the start."""


class PPOSettings(Checked):
    """Hyperparameters of PPO."""

    hidden: tuple[Annotated[int, Field(ge=1)], ...] = (64, 64)
    """Widths of the hidden layers of actor and critic."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Learning rate of Adam, for actor and critic."""
    gamma: Annotated[float, Field(ge=0, le=1)] = 0.99
    """Discount factor."""
    gae_lambda: Annotated[float, Field(ge=0, le=1)] = 0.95
    """Lambda of the generalised advantage estimates: 0 relies on the critic, 1 on the rewards."""
    epochs: Annotated[int, Field(ge=1)] = 10
    """Number of passes over the rollout in one update."""
    minibatch_size: Annotated[int, Field(ge=1)] = 64
    """Steps in one gradient step; a step of each agent counts by itself."""
    clip: Annotated[float, Field(gt=0)] = 0.2
    """How far the probability ratio may move from 1."""
    value_clip: Annotated[float, Field(gt=0)] = 0.5
    """How far the value may move in one update, in standard deviations of the return."""
    value_coef: Annotated[float, Field(ge=0)] = 0.5
    """Coefficient of the value loss."""
    entropy_coef: Annotated[float, Field(ge=0)] = 0.0
    """Coefficient of the entropy bonus."""
    huber_delta: Annotated[float, Field(gt=0)] = 10.0
    """Error at which the value loss turns from quadratic to linear, in standard deviations of the return."""
    max_grad_norm: Annotated[float, Field(gt=0)] = 0.5
    """Largest norm of the gradient of actor and critic together; a larger gradient is scaled down to it."""
    anneal: bool = False
    """Let learning rate and clip fall linearly to 0 over the run."""
    normalise_observations: bool = False
    """Normalise the networks' observations by their running mean and standard deviation."""


class QMIXSettings(Checked):
    """Hyperparameters, as PyMARL2 sets them for most maps of the StarCraft challenge."""

    hidden: Annotated[int, Field(ge=1)] = 64
    """Width of the agents' network and of its memory."""
    monotonic: bool = True
    """Mix the agents' values by a monotonic network; otherwise add them up, which is VDN."""
    embed: Annotated[int, Field(ge=1)] = 32
    """Width of the mixer."""
    hypernet: Annotated[int, Field(ge=1)] = 64
    """Width of the hidden layers of the hypernetworks, which compute the mixer's weights."""
    learning_rate: Annotated[float, Field(gt=0)] = 1e-3
    """Learning rate of Adam, for all networks."""
    gamma: Annotated[float, Field(ge=0, le=1)] = 0.99
    """Discount factor."""
    td_lambda: Annotated[float, Field(ge=0, le=1)] = 0.6
    """Lambda of the TD(lambda) targets: 0 relies on the target networks, 1 on the rewards."""
    max_grad_norm: Annotated[float, Field(gt=0)] = 10.0
    """Largest norm of the gradient of agents and mixer together; a larger gradient is scaled down to it."""
    batch_size: Annotated[int, Field(ge=1)] = 128
    """Episodes in one update."""
    update_every: Annotated[int, Field(ge=1)] = 8
    """Number of new episodes for each update."""
    target_every: Annotated[int, Field(ge=1)] = 200
    """Number of episodes between two copies of the online networks to the target networks."""
    epsilon_start: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Probability that an agent explores, at the start."""
    epsilon_end: Annotated[float, Field(ge=0, le=1)] = 0.05
    """Probability that an agent explores, at the end."""
    epsilon_steps: Annotated[int, Field(ge=1)] = 100_000
    """Environment steps over which this probability falls linearly."""

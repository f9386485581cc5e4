"""A transform for TorchRL's replay buffers, which samples steps with r_hat of a `CreditAssigner` as their rewards.

    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000_000), batch_size=256, transform=CreditTransform(credit))
    buffer.extend(collected)   # shows the steps to the assigner
    buffer.sample()            # ("next", "reward") is r_hat, by the newest decoder

The environment's rewards stay in the collected data, and are not stored in the buffer.
"""

from typing import Any

import numpy as np

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.layout import Layout
from lare_rl.errors import LareError, needs_extra
from lare_rl.integrations.space_checks import check_assigner

try:
    import torch
    from tensordict import TensorDictBase
    from torchrl.envs.transforms import Transform
except ModuleNotFoundError as error:
    raise needs_extra("lare_rl.integrations.torchrl", "torchrl") from error

CREDIT_STEP = "credit_step"
"""The buffer's key for the numbers of steps."""
REWARD = ("next", "reward")
TRAJECTORY = ("collector", "traj_ids")
"""The key under which TorchRL's collectors store the trajectory of a step."""


class CreditTransform(Transform):
    """Shows steps to an assigner as they go into a replay buffer, and sets the rewards of sampled steps to r_hat.

    The buffer stores the number of each step ("credit_step") and a reward of 0 instead of the environment's. An episode ends
    where ("next", "done"), "terminated" or "truncated" is true. A collector names the trajectory of each step. Without a collector,
    the last dimension of the batch is time, and the next batch continues the episodes of this one.

    It may be called from several threads. Before every sample, the decoder's updates that are due are made.
    """

    def __init__(self, credit: CreditAssigner, observation: Any = None, action: Any = "action"):
        """A transform for one replay buffer.

        Args:
            credit: the assigner. It must keep at least as many steps as the buffer (`capacity`).
            observation: the key of the observation. The default is "observation", or one key for each part of a Dict space.
            action: the key of the action.

        Raises:
            LareError: the assigner is one for many agents.
        """
        super().__init__()
        check_assigner(credit)
        if credit.config.agents > 1:
            raise LareError(
                f"CreditTransform pays a single agent, and the assigner has agents = {credit.config.agents}"
            )
        self.credit = credit
        parts = credit.config.observation.names
        self.observation = observation if observation is not None else ({name: name for name in parts} or "observation")
        self.action = action
        self.lanes = object()
        """A key that no other transform of the assigner has."""

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Show new steps to the assigner, and store their numbers instead of their rewards."""
        if REWARD not in tensordict.keys(include_nested=True):
            raise LareError(
                'CreditTransform belongs to a replay buffer of whole steps, with ("next", "reward"): '
                f"there are {', '.join(map(str, tensordict.keys()))}"
            )
        after, known = tensordict.get("next"), self.credit.config
        steps = self.credit.add(
            batch_of(tensordict, self.observation, known.observation),
            batch_of(tensordict, self.action, known.action),
            batch_of(after, self.observation, known.observation),
            flat(after, "reward").reshape(-1),
            flags(after, "terminated") | flags(after, "done"),
            flags(after, "truncated"),
            lanes=self.lanes_of(tensordict),
        )
        reward = tensordict.get(REWARD)
        numbers = torch.as_tensor(steps, device=reward.device).reshape(tensordict.batch_size)
        return tensordict.set(CREDIT_STEP, numbers).set(REWARD, torch.zeros_like(reward))

    def lanes_of(self, tensordict: TensorDictBase) -> list[tuple[object, int]]:
        """A key for each step's trajectory."""
        names = tensordict.get(TRAJECTORY, None)
        if names is not None:
            return [(self.lanes, name) for name in names.reshape(-1).tolist()]
        time = tensordict.batch_size[-1] if tensordict.batch_dims else 1
        return [(self.lanes, -1 - place // time) for place in range(tensordict.numel())]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Set the rewards of sampled steps to r_hat."""
        steps, reward = tensordict.get(CREDIT_STEP, None), tensordict.get(REWARD)
        if steps is None:
            raise LareError(f"the sample has no {CREDIT_STEP!r}: it went into the buffer without this transform")
        self.credit.fit_owed()
        r_hat = self.credit.rewards_at(steps.cpu().numpy())
        paid = torch.as_tensor(r_hat, dtype=reward.dtype, device=reward.device)
        return tensordict.set(REWARD, paid.reshape(reward.shape))


def flat(tensordict: TensorDictBase, key: Any) -> np.ndarray:
    """The values under a key, with the axes of the batch merged into one axis of steps."""
    values = tensordict.get(key).detach().cpu().numpy()
    return values.reshape(-1, *values.shape[tensordict.batch_dims :])


def flags(tensordict: TensorDictBase, key: str) -> np.ndarray:
    """The flags under a key, one for each step; false if there is no such key."""
    if key not in tensordict.keys():  # noqa: SIM118
        return np.zeros(tensordict.numel(), bool)
    return flat(tensordict, key).reshape(-1)


def batch_of(tensordict: TensorDictBase, key: Any, layout: Layout) -> Any:
    """Observations or actions in the form that the assigner takes. In TorchRL, choices are one-hot rows of flags, or numbers."""
    if isinstance(key, dict):
        parts = zip(layout.names, layout.parts, strict=True)
        return {name: batch_of(tensordict, key[name], part) for name, part in parts}
    values = flat(tensordict, key)
    marked = layout.kind == "choices" and values.ndim == 2 and values.shape[1] == layout.size > 1
    return values.astype(np.float32) if marked else values

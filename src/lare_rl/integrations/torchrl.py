"""A transform for TorchRL's replay buffers: the rewards of sampled steps are r_hat of a `CreditAssigner`.

    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000_000), batch_size=256, transform=CreditTransform(credit))
    buffer.extend(collected)   # shows the steps to the assigner
    buffer.sample()            # ("next", "reward") is r_hat, by the newest decoder

The environment's rewards stay in the collected data, and are not stored in the buffer.
"""

from typing import Any

import numpy as np

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.assigner.space_layout import SpaceLayout
from lare_rl.errors import LareError, missing_extra_error
from lare_rl.integrations.recorder import CREDIT_STEP, check_assigner

try:
    import torch
    from tensordict import TensorDictBase
    from torchrl.envs.transforms import Transform
except ImportError as missing:
    raise missing_extra_error("lare_rl.integrations.torchrl", "torchrl") from missing

__all__ = ["CREDIT_STEP", "REWARD", "CreditTransform"]

REWARD = ("next", "reward")
TRAJECTORY, MASK = ("collector", "traj_ids"), ("collector", "mask")
"""The keys under which TorchRL's collectors store the trajectory of a step, and whether a row is a step. `split_trajs` adds other rows, as
padding."""


class CreditTransform(Transform):
    """Shows steps to an assigner as they go into a replay buffer, and sets the rewards of sampled steps to r_hat.

    The buffer stores the number of each step ("credit_step") and a reward of 0 instead of the environment's. An episode ends
    where ("next", "done"), "terminated" or "truncated" is true. A collector names the trajectory of each step. Without a collector,
    the last dimension of the batch is time, and the next batch continues the episodes of this one. If the task has a `group`, each step
    has its group at ("next", KEY), where KEY is the value of `group`. An info reader of TorchRL fills it.

    It may be called from several threads. Before every sample, the pending updates of the decoder are made.
    """

    def __init__(self, credit: CreditAssigner, observation: Any = None, action: Any = "action"):
        """Create a transform for one replay buffer.

        Args:
            credit: the assigner, for one agent. It must keep at least as many steps as the buffer (`capacity`).
            observation: the key of the observation. The default is "observation", or one key for each part of a Dict space.
            action: the key of the action.
        """
        super().__init__()
        check_assigner(credit)
        self.credit = credit
        names = credit.config.observation.names
        self.observation = observation if observation is not None else ({name: name for name in names} or "observation")
        self.action = action
        self._id = object()
        """Distinguishes the trajectories from those of other transforms of the assigner."""

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Show new steps to the assigner, and store their numbers instead of their rewards."""
        if REWARD not in tensordict.keys(include_nested=True):
            raise LareError(
                'CreditTransform is for replay buffers of steps, with ("next", "reward"), and the keys are '
                f"{', '.join(map(str, tensordict.keys()))}"
            )
        next_, config = tensordict.get("next"), self.credit.config
        has_group = config.groups and config.group_key in next_.keys()  # noqa: SIM118
        has_mask = MASK in tensordict.keys(include_nested=True)
        steps = self.credit.add(
            _read_elements(tensordict, self.observation, config.observation),
            _read_elements(tensordict, self.action, config.action),
            _read_elements(next_, self.observation, config.observation),
            _flatten(next_, "reward").reshape(-1),
            _read_flags(next_, "terminated") | _read_flags(next_, "done"),
            _read_flags(next_, "truncated"),
            env_ids=self._trajectories(tensordict),
            valid=_flatten(tensordict, MASK).reshape(-1) if has_mask else None,
            group=_flatten(next_, config.group_key).reshape(-1).tolist() if has_group else None,
        )
        reward = tensordict.get(REWARD)
        numbers = torch.as_tensor(steps, device=reward.device).reshape(tensordict.batch_size)
        return tensordict.set(CREDIT_STEP, numbers).set(REWARD, torch.zeros_like(reward))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Set the rewards of sampled steps to r_hat."""
        steps, reward = tensordict.get(CREDIT_STEP, None), tensordict.get(REWARD)
        if steps is None:
            raise LareError(f"the sample has no {CREDIT_STEP!r}: add the steps to the buffer with this transform")
        self.credit.fit_pending()
        dtype = reward.dtype if reward.is_floating_point() else torch.float32  # they may be whole numbers
        r_hat = torch.as_tensor(self.credit.rewards_at(steps.cpu().numpy()), dtype=dtype, device=reward.device)
        return tensordict.set(REWARD, r_hat.reshape(reward.shape))

    def _trajectories(self, tensordict: TensorDictBase) -> list[tuple[object, int]]:
        """Return a key for the episode (TorchRL: trajectory) of each step."""
        trajectories = tensordict.get(TRAJECTORY, None)
        if trajectories is not None:
            return [(self._id, number) for number in trajectories.reshape(-1).tolist()]
        n_times = tensordict.batch_size[-1] if tensordict.batch_dims else 1
        # Negative, because collectors count trajectories from 0.
        return [(self._id, -1 - step // n_times) for step in range(tensordict.numel())]


def _flatten(tensordict: TensorDictBase, key: Any) -> np.ndarray:
    """Return the values under a key, with one axis of steps instead of the axes of the batch."""
    values = tensordict.get(key).detach().cpu().numpy()
    return values.reshape(-1, *values.shape[tensordict.batch_dims :])


def _read_flags(tensordict: TensorDictBase, key: str) -> np.ndarray:
    """Return the flag of each step under a key, or false if there is no such key."""
    if key not in tensordict.keys():  # noqa: SIM118
        return np.zeros(tensordict.numel(), bool)
    return _flatten(tensordict, key).reshape(-1)


def _read_elements(tensordict: TensorDictBase, key: Any, layout: SpaceLayout) -> Any:
    """Return observations or actions in the form that the assigner takes. In TorchRL, choices are one-hot rows or numbers."""
    if isinstance(key, dict):
        children = zip(layout.names, layout.inner, strict=True)
        return {name: _read_elements(tensordict, key[name], child) for name, child in children}
    if isinstance(inner := tensordict.get(key), TensorDictBase):  # of a Dict space in a Dict space
        return _read_elements(inner, {name: name for name in layout.names}, layout)
    values = _flatten(tensordict, key)
    is_one_hot = layout.kind == "choices" and values.ndim == 2 and values.shape[1] == layout.size > 1
    return values.astype(np.float32) if is_one_hot else values

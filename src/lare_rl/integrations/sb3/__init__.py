"""Stable-Baselines3, sb3-contrib and SBX: replay buffers and a callback that replace rewards by r_hat.

    from lare_rl.integrations.sb3 import CreditCallback, CreditReplayBuffer

    TD3("MlpPolicy", env, replay_buffer_class=CreditReplayBuffer, replay_buffer_kwargs={"credit": credit})   # or SAC, DQN, TQC, ...
    PPO("MlpPolicy", env).learn(1_000_000, callback=CreditCallback(credit))                              # or A2C, TRPO, ...

The environment's rewards are unchanged, so that the returns that are logged and evaluated are the true ones.
"""

import re

from lare_rl.errors import LareError, install_command, missing_extra_error

try:
    import stable_baselines3
except ImportError:
    raise missing_extra_error("lare_rl.integrations.sb3", "sb3") from None
if [int(number) for number in re.findall(r"\d+", stable_baselines3.__version__)[:2]] < [2, 9]:
    raise LareError(
        f"lare_rl.integrations.sb3 needs stable-baselines3 2.9 or later, and {stable_baselines3.__version__} is installed: "
        f"{install_command('sb3')} --upgrade"
    )

from lare_rl.integrations.sb3.buffers import CreditDictReplayBuffer, CreditNStepReplayBuffer, CreditReplayBuffer
from lare_rl.integrations.sb3.callback import CreditCallback

__all__ = ["CreditCallback", "CreditDictReplayBuffer", "CreditNStepReplayBuffer", "CreditReplayBuffer"]

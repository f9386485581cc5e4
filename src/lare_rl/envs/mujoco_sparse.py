"""Additional tasks on Gymnasium's MuJoCo environments."""

from typing import Any

import gymnasium
from gymnasium.envs.registration import WrapperSpec
from gymnasium.utils import RecordConstructorArgs

SPARSE_HALF_CHEETAH = "lare/HalfCheetahSparse-v4"


class PaysForDistance(gymnasium.Wrapper, RecordConstructorArgs):
    """Pays 1 at the end of an episode that has travelled further than `distance` metres, and otherwise nothing.

    This is the fully sparse task of the LaRe paper, appendix F.6: I(final travel distance > 500). The published code requires a
    summed forward reward above 1000 instead, which corresponds to 50 m at 0.05 s a step.
    """

    def __init__(self, env: gymnasium.Env, distance: float = 500.0):
        RecordConstructorArgs.__init__(self, distance=distance)
        gymnasium.Wrapper.__init__(self, env)
        self.distance = distance

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, _, terminated, truncated, info = self.env.step(action)
        arrived = (terminated or truncated) and info["x_position"] > self.distance
        return observation, float(arrived), terminated, truncated, info


def register() -> None:
    """Register the environments with Gymnasium. Further calls change nothing."""
    if SPARSE_HALF_CHEETAH not in gymnasium.registry:
        usual = gymnasium.registry["HalfCheetah-v4"]
        # Gymnasium applies additional wrappers outside the time limit, so that this one sees the end of the episode.
        pays = WrapperSpec("PaysForDistance", f"{__name__}:PaysForDistance", {"distance": 500.0})
        gymnasium.register(
            SPARSE_HALF_CHEETAH,
            entry_point=usual.entry_point,
            max_episode_steps=usual.max_episode_steps,
            additional_wrappers=(pays,),
        )

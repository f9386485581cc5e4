"""The number of rows of the replay."""

from lare_rl.config.effective import needs_replay
from lare_rl.config.settings import ResolvedSettings
from lare_rl.credit.decoder_settings import RECENT_STEPS
from lare_rl.data.replay import required_capacity

__all__ = ["replay_rows"]


def replay_rows(settings: ResolvedSettings, max_steps: int) -> int:
    """Return the rows of each environment, if an episode has up to `max_steps` steps."""
    required = required_capacity(settings.rollout_steps, max_steps)
    rows = settings.capacity // settings.environments
    if not needs_replay(settings):  # only to compare the newest rewards with the true ones
        rows = required + RECENT_STEPS // settings.environments
    return min(rows, max(required, 2 * settings.steps // settings.environments + 2))

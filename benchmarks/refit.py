"""How stable a decoder's credit is: new decoders are fitted to the replay of a finished run, and compared with the true rewards.

    python benchmarks/refit.py RUN [RUN ...]

For each run (of a method with a decoder, first seed) there are three fits: the method's own, the same with targets in the units of
the environment, and RRD's biased loss. After every 5,000 of 20,000 updates: the correlation with the true rewards and the mean
error on the last 5,000 stored steps. The best possible result (`ceiling`) is that of a linear map that is fitted to the true
rewards of the same steps.
"""

import sys
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.config.train_config import TrainConfig
from lare_rl.credit import decoder_state, descent
from lare_rl.credit.decoder_settings import RECENT_STEPS
from lare_rl.credit.decoder_state import CreditBatch, DecoderState
from lare_rl.credit.methods import Fit
from lare_rl.credit.spec import CreditSpec
from lare_rl.data import replay
from lare_rl.data.sampling import CreditSample, sample_episode_steps
from lare_rl.nn.normalise import Scale
from lare_rl.runs.directory import open_run
from lare_rl.training.decoder_inputs import decoder_inputs
from lare_rl.training.learner import Learner
from lare_rl.training.rewards import masked_correlation, mean_absolute_error
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import select_seed
from measure import write

UPDATES, STRETCH = 20_000, 5_000


@partial(jax.jit, static_argnames=("spec", "config"))
def updates(
    credit: DecoderState, stored_replay: replay.Replay, key: jax.Array, spec: CreditSpec, config: TrainConfig
) -> DecoderState:
    def update(credit: DecoderState, sample: CreditSample) -> tuple[DecoderState, None]:
        features = decoder_inputs(replay.read(stored_replay, sample.steps), config, 0)
        chosen = sample.episodes
        episodes = CreditBatch(features, sample.episode_index, chosen.length, chosen.mean_reward[..., 0], chosen.mask)
        return descent.update(credit, episodes, key, spec)[0], None

    n_steps = min(config.credit.sampled_steps, config.env.max_steps)
    n_episodes = max(1, config.credit.batch_steps // config.credit.sampled_steps)
    samples = sample_episode_steps(stored_replay, key, STRETCH, n_episodes, n_steps)
    return jax.lax.scan(update, credit, samples)[0]


def newest(learner: Learner, config: TrainConfig) -> tuple[jax.Array, jax.Array]:
    """Features and true rewards of the last steps."""
    recent = replay.read_newest(learner.replay, RECENT_STEPS)
    return decoder_inputs(recent, config, 0)[0], recent.columns["reward"][0, :, 0]


def refit(learner: Learner, config: TrainConfig, fit: Fit | None, scale: Scale) -> list[dict[str, float]]:
    (decoder,) = learner.decoders
    (features, reward), valid = newest(learner, config), jnp.ones(RECENT_STEPS, bool)
    spec = config.credit_specs[0]
    spec = replace(spec, method=replace(spec.method, fit=fit))
    credit = decoder_state.init(jax.random.key(0), spec)
    credit = credit._replace(statistics=decoder.statistics, scale=scale)
    rows = []
    for number in range(UPDATES // STRETCH):
        credit = updates(credit, learner.replay, jax.random.key(number), spec, config)
        r_hat = decoder_state.decoder_rewards(credit, features, spec)[:, 0]
        rows.append(
            {
                "updates": (number + 1) * STRETCH,
                "correlation": float(masked_correlation(r_hat, reward, valid)),
                "error": float(mean_absolute_error(r_hat, reward, valid)),
            }
        )
    return rows


def ceiling(learner: Learner, config: TrainConfig) -> float:
    features, reward = (np.asarray(array) for array in newest(learner, config))
    rows = np.c_[features[:, 0], np.ones(RECENT_STEPS)]
    best = rows @ np.linalg.lstsq(rows, reward, rcond=None)[0]
    return float(np.corrcoef(best, reward)[0, 1])


def main(directories: list[str]) -> None:
    results = {}
    for directory in directories:
        run = open_run(directory)
        config, everyone, _, _ = load_learner(run)
        learner = select_seed(everyone)
        scale_state = learner.decoders[0].scale
        unit = scale_state._replace(mean_square=jnp.ones(()))
        cases = {
            "as it is": (config.method.fit, scale_state),
            "targets as they are": (config.method.fit, unit),
            "biased": (Fit.SAMPLED_STEPS, scale_state),
        }
        rows = {name: refit(learner, config, *case) for name, case in cases.items()}
        ceilings = [ceiling(select_seed(everyone, seed_index), config) for seed_index in range(len(run.seeds))]
        results[f"{run.config.task.name} {run.config.settings.method}"] = {"ceiling of each seed": ceilings, **rows}
        print(f"{directory}: ceiling {', '.join(f'{value:.3f}' for value in ceilings)}")
        for name, steps in rows.items():
            print(f"  {name:20s}", "  ".join(f"{at['correlation']:.2f} (error {at['error']:.2f})" for at in steps))
    write("refit", {"results": results})


if __name__ == "__main__":
    main(sys.argv[1:] or sys.exit(__doc__))

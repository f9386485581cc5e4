"""The replay: the cost of a draw by the number of stored transitions, and the memory of a full replay.

    python benchmarks/replay.py             a draw at 10 thousand, 100 thousand and 1 million transitions
    python benchmarks/replay.py --memory    peak memory of a whole process that trains on a full replay

A draw has the data of one update of LaRe-RRDu on HalfCheetah-v4: 256 transitions, and 64 steps of each of 4 episodes. The three
replays take turns. For the memory, a session on HumanoidStandup-v4 (376 numbers in an observation) has its replay of a million
observations filled with random numbers, in the same way as with its own steps, and then continues training.
"""

import resource
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import psutil
import tyro

import lare_rl
from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.algorithms.td3 import TD3Settings
from lare_rl.config.train_config import TrainConfig
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.data import replay
from lare_rl.data.replay import Index, Replay
from lare_rl.data.sampling import CreditSample, sample_transitions
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import EnvSpec, Team, Timestep
from lare_rl.training.decoder_fits import sample_credit
from lare_rl.training.decoder_inputs import decoder_inputs
from lare_rl.training.session import Session
from measure import advance, interleave, new_session, show, summary, write

SEED, EPISODE, UPDATES = 0, 1000, 50
SETTINGS = TD3Settings()
STORED = (10_000, 100_000, 1_000_000)
CONFIG = TrainConfig(
    env=EnvSpec((Team("agent", 0, 1),), observation_size=17, action_size=6, discrete=False, max_steps=EPISODE),
    credit_scope="observation",
    scored_observation="after",
    method=METHODS.find("lare-rrdu"),
    consumes=ALGORITHMS["td3"].consumes,
    algorithm=ALGORITHMS["td3"],
    hyperparameters=SETTINGS,
    credit=CreditSettings(),
    scale_rewards=False,
    n_factors=(6,),
    n_envs=1,
    rollout_steps=UPDATES,
    capacity=1_010_000,
    steps=1_000_000,
    fit_updates=1,
)
"""A configuration with the sizes of HalfCheetah-v4."""


def filled(transitions: int) -> Replay:
    """A replay of whole episodes of 1000 random steps, with a leading seed axis of 1."""
    random, number = np.random.default_rng(SEED), np.arange(transitions)
    episodes, stored_replay = transitions // EPISODE, replay.init_replay(CONFIG.columns, 1, CONFIG.capacity, 1)

    def numbers(column: jax.Array) -> np.ndarray:
        return random.standard_normal(column.shape, np.float32).astype(column.dtype)

    stored_replay = stored_replay._replace(
        columns={name: numbers(column) for name, column in stored_replay.columns.items()},
        row=np.asarray(stored_replay.row.at[0, :transitions].set(number + number // EPISODE)),
        episode=np.asarray(stored_replay.episode.at[0, :transitions].set(number // EPISODE)),
        first=np.asarray(stored_replay.first.at[0, :episodes].set(EPISODE * np.arange(episodes))),
        episode_return=numbers(stored_replay.episode_return),
        next_row=jnp.asarray([episodes * (EPISODE + 1)]),
        next_transition=jnp.asarray([transitions]),
        current_episode=jnp.asarray([episodes]),
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], stored_replay)


def reads(stored_replay: Replay, key: jax.Array) -> Any:
    """Read the data of 50 updates, one after the other; returns the data of the last one."""
    batch_key, credit_key = jax.random.split(key)
    draws = (
        sample_transitions(stored_replay, batch_key, (UPDATES, SETTINGS.batch_size)),
        sample_credit(stored_replay, credit_key, UPDATES, CONFIG),
    )

    def use(draw: tuple[Index, CreditSample]) -> Any:
        credit_steps, batch = replay.read(stored_replay, draw[1].steps), replay.read(stored_replay, draw[0])
        credit = decoder_inputs(credit_steps, CONFIG, 0), draw[1].episodes
        before, after = batch.columns, batch.next_columns
        read = before["observation"], before["action"], after["observation"], before["terminated"]
        return credit, decoder_inputs(batch, CONFIG, 0), read

    start = jax.tree.map(jnp.zeros_like, use(jax.tree.map(lambda leaf: leaf[0], draws)))
    return jax.lax.scan(lambda _, draw: (use(draw), None), start, draws)[0]


def draws(rounds: int, calls: int) -> None:
    """Measure the time of draws."""
    compiled = jax.jit(jax.vmap(reads))

    def work(stored_replay: Replay) -> None:
        for call in range(calls):
            jax.block_until_ready(compiled(stored_replay, jax.random.split(jax.random.key(call), 1)))

    contenders: dict[str, Callable[[], object]] = {f"{stored:,}": partial(work, filled(stored)) for stored in STORED}
    table = summary(interleave(contenders, rounds), calls * UPDATES, f"{STORED[0]:,}")
    show("draw, by transitions stored", table, f"{STORED[0]:,}")
    write("replay", {"seeds": [SEED], "rounds": rounds, "draws in a round": calls * UPDATES, "draw": table})


def fill(session: Session, transitions: int) -> None:
    """Put random steps into a session's replay, by its own compiled `store`."""
    config, random = session.config, np.random.default_rng(SEED)
    env, rollout = config.env, config.rollout_steps
    zeros = {
        "available": np.ones((1, rollout, 1, 1, env.action_size), bool),
        "alive": np.ones((1, rollout, 1, 1), bool),
    }

    def numbers(*shape: int) -> np.ndarray:
        return random.standard_normal((1, rollout, 1, *shape), np.float32)

    def timestep(ended: np.ndarray) -> Timestep:
        return Timestep(
            observation=numbers(1, env.observation_size),
            state=numbers(0),
            reward=numbers(1),
            terminated=np.zeros_like(ended),
            truncated=ended,
            measures={},
            **zeros,
        )

    for start in range(0, transitions, rollout):
        ended = ((start + 1 + np.arange(rollout)) % EPISODE == 0)[None, :, None]
        action = numbers(1, env.action_size)
        steps = Trajectory(timestep(np.zeros_like(ended)), action, action, timestep(ended))
        session.learner, _ = session.functions.store(session.learner, steps)
    session.step = transitions


def used() -> dict[str, int]:
    """Memory of this process in bytes, now and at its peak so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return {"resident": psutil.Process().memory_info().rss, "peak": peak}


def memory(transitions: int) -> None:
    """Fill a replay, continue training, and measure the memory."""
    stages = {"packages imported": used()}
    with tempfile.TemporaryDirectory() as folder:
        settings = lare_rl.Settings(method="lare-rrdu", seed=SEED)
        session = new_session(Path(folder) / "run", "HumanoidStandup-v4", settings)
        jax.block_until_ready(session.learner)
        stages["session begun"] = used()
        fill(session, transitions)
        jax.block_until_ready(session.learner)
        stages["replay filled"] = used()
        advance(session, 1000)
        stages["1000 training steps later"] = used()
        session.close()
    arrays = sum(leaf.nbytes for leaf in jax.tree.leaves(session.learner.replay))
    stored_replay = session.learner.replay
    stored = int(jax.vmap(replay.n_stored_transitions)(stored_replay)[0, 0])
    print(f"{stored:,} transitions stored; the arrays of the replay: {arrays / 1e9:.3f} GB")
    for stage, bytes_used in stages.items():
        print(f"{stage:28s} resident {bytes_used['resident'] / 1e9:.3f} GB, peak {bytes_used['peak'] / 1e9:.3f} GB")
    write("memory", {"seeds": [SEED], "transitions stored": stored, "bytes of the replay": arrays, "bytes": stages})


@dataclass
class Arguments:
    """What to measure."""

    memory: bool = False
    """Measure memory instead of time."""
    rounds: int = 7
    """Number of turns of each replay."""
    calls: int = 40
    """Calls, of 50 draws each, in a turn."""
    transitions: int = 1_000_000
    """Transitions that are stored before the memory is measured; a multiple of 1000."""


if __name__ == "__main__":
    arguments = tyro.cli(Arguments, description=__doc__)
    if arguments.memory:
        memory(arguments.transitions)
    else:
        draws(arguments.rounds, arguments.calls)

"""PPO of RLlib on a Pendulum that pays its return only at the end of an episode.

    pip install 'ray[rllib]==2.60.0' torch
    python examples/rllib_ppo.py

`Credit` is the outermost wrapper of each environment. It passes every step to the assigner, and puts the number of the
step into `info`. `PayCredit` is part of the learner's connector. When a rollout is complete, it fits the decoder and
pays all steps, before PPO computes advantages. The episodes keep the environment's rewards, so the returns that RLlib
reports do not change.

* Actions: RLlib converts them to the environment's units before it takes a step.
* Ends: RLlib uses Gymnasium's NEXT_STEP mode and leaves resets out. `Credit` wraps each single environment, so it
  receives no reset as a step.

What does not work: `num_env_runners` or `num_learners` above 0. Environments or learner then run in other processes,
and the assigner is in this one. With runners, RLlib stops, because they do not find the environment. With learners,
`PayCredit` has a copy of the assigner that received no steps, and raises `LareError`. `num_envs_per_env_runner` may be
any number.

With a latent function (docs/how-to/write-phi.md), create the assigner like this:

    task = lare_rl.load_task("pendulum.toml")
    credit = lare_rl.CreditAssigner("lare-bayes", lare_rl.load_function("phi.py", task), task=task)

It ran with RLlib 2.60.0, torch 2.13.0, Python 3.11 and Gymnasium 1.2.2, the version that this RLlib requires: use a
separate virtual environment. It took a minute on one core. Seed 0 printed, after warnings of RLlib itself:

    iteration 0: mean return -1432
    iteration 13: mean return -873
    iteration 26: mean return -570
    iteration 39: mean return -178
    {'credit/return_r2': 0.9990494251251221, 'credit/episodes': 320.0, 'credit/dropped': 0.0, ...}

Seeds 1 and 2: from -1185 to -80, and from -1191 to -80. Without `learner_connector`, PPO trains on the return at the
end, and seed 0 goes from -1432 to -1631.
"""

import gymnasium
import numpy as np
import ray
import tyro
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.core.columns import Columns

import lare_rl
from lare_rl.integrations.gymnasium import Credit


class PayCredit(ConnectorV2):
    """Pays the steps of a complete rollout, before PPO computes advantages."""

    def __init__(self, credit):
        super().__init__()
        self.credit = credit

    def __call__(self, *, batch, episodes, **kwargs):
        self.credit.fit()
        for episode in self.single_agent_episode_iterator(episodes, agents_that_stepped_only=False):
            rows = len(episode)  # its steps and one more: PPO has added a last row, which is not a step
            steps = [info["credit_step"] for info in episode.get_infos(slice(1, rows))]
            rewards = np.append(self.credit.rewards_at(steps), 0)
            self.add_n_batch_items(batch, Columns.REWARDS, rewards, rows, episode)
        return batch


def main(iterations: int = 40, seed: int = 0) -> list[float]:
    """Train. Gives the mean return of each iteration (sums of the rewards of the environment)."""
    # Before the assigner: Ray forks, and JAX warns about forks once it runs.
    ray.init(include_dashboard=False)
    environment = gymnasium.make("Pendulum-v1")
    credit = lare_rl.CreditAssigner(
        "bayes", observation_space=environment.observation_space, action_space=environment.action_space
    )

    def make(**settings):
        env = lare_rl.EpisodicReward(gymnasium.make("Pendulum-v1", **settings))
        return Credit(env, credit, pay="environment")

    # Register with Gymnasium: Ray's `register_env` would copy the assigner, and the steps would go to the copy.
    gymnasium.register("EpisodicPendulum-v0", entry_point=make)
    config = (
        PPOConfig()
        .environment("EpisodicPendulum-v0")
        .env_runners(num_env_runners=0, num_envs_per_env_runner=8)
        .learners(num_learners=0, learner_connector=lambda observations, actions: PayCredit(credit))
        .training(gamma=0.95, lambda_=0.9, lr=5e-4, vf_clip_param=1000.0, num_epochs=8)
        .training(train_batch_size_per_learner=1600, minibatch_size=128)
        .debugging(seed=seed)
    )
    algorithm = config.build_algo()
    returns = []
    for iteration in range(iterations):
        returns.append(float(algorithm.train()["env_runners"]["episode_return_mean"]))
        if iteration % 13 == 0:
            print(f"iteration {iteration}: mean return {returns[-1]:.0f}")
    algorithm.stop()
    ray.shutdown()
    print(credit.metrics())
    return returns


if __name__ == "__main__":
    tyro.cli(main)

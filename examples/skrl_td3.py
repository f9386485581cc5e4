"""TD3 of skrl on a Pendulum that pays its return only at the end of an episode.

    pip install skrl==2.1.1
    python examples/skrl_td3.py

`VectorCredit` wraps the vector environment and passes its steps to the assigner. The memory cannot do this, because
skrl does not tell it which episodes a time limit has truncated. `CreditMemory` replaces a `RandomMemory`. When it is
sampled, it asks the assigner for the current proxy rewards of these steps.

* Actions: the actor's actions are in the environment's units, so memory and environment have the same actions.
* Ends: in SAME_STEP mode every row is a step. But after the last step of an episode, skrl would store the first
  observation of the next episode. `CreditTD3` stores `final_obs`. In NEXT_STEP mode, Gymnasium's default, skrl stores
  resets as if they were steps.
* The memory asks by observations and actions, not by numbers of steps. The method `ircr` needs numbers.

With a latent function (docs/how-to/write-phi.md), create the assigner like this:

    task = lare_rl.load_task("pendulum.toml")
    credit = lare_rl.CreditAssigner("lare-bayes", lare_rl.load_function("phi.py", task), task=task)

It ran with skrl 2.1.1, Gymnasium 1.4.0, torch 2.13.0 and Python 3.11, for a minute on one core. Seed 0 printed:

    mean return of the first and of the last ten episodes: -1319, -139
    {'credit/return_r2': 0.9985870718955994, 'credit/episodes': 50.0, 'credit/dropped': 0.0, ...}

Seeds 1 and 2: from -1237 to -147, and from -1381 to -184. With `RandomMemory(memory_size=50_000, num_envs=2)`, TD3
trains on the return at the end, and seed 0 goes from -1373 to -948.
"""

import gymnasium
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from skrl.agents.torch.td3 import TD3, TD3_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, Model
from skrl.resources.noises.torch import GaussianNoise
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import nn

import lare_rl
from lare_rl.integrations.gymnasium import VectorCredit


class CreditMemory(RandomMemory):
    """Replaces the rewards of sampled steps by those of the newest decoder."""

    def __init__(self, credit, **settings):
        super().__init__(**settings)
        self.credit = credit

    def sample_by_index(self, names, *, indexes, mini_batches=1):
        self.credit.fit_pending()
        batches = super().sample_by_index(names, indexes=indexes, mini_batches=mini_batches)
        for batch in batches:
            rows = dict(zip(names, batch, strict=True))  # copies of the stored rows
            r_hat = self.credit.rewards(rows["observations"], rows["actions"], rows["next_observations"])
            rows["rewards"][:, 0] = torch.as_tensor(r_hat)
        return batches


class CreditTD3(TD3):
    """Stores the last observation of an episode, where skrl stores the first observation of the next one."""

    def record_transition(self, *, next_observations, infos, **kwargs):
        if "final_obs" in infos:
            ended = infos["_final_obs"]
            next_observations = next_observations.clone()  # skrl's trainer continues from the original
            next_observations[ended] = torch.as_tensor(np.stack(infos["final_obs"][ended]))
        super().record_transition(next_observations=next_observations, infos=infos, **kwargs)


class Network(DeterministicMixin, Model):
    def __init__(self, env, inputs):
        Model.__init__(self, observation_space=env.observation_space, action_space=env.action_space)
        DeterministicMixin.__init__(self)
        hidden = nn.Linear(inputs, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU()
        self.layers = nn.Sequential(*hidden, nn.Linear(128, 1))


class Actor(Network):
    def compute(self, inputs, role=""):
        return 2 * torch.tanh(self.layers(inputs["observations"])), {}  # Pendulum's actions are from -2 to 2

    def random_act(self, inputs, *, role=""):
        # skrl 2.1's own method gives the same actions in every call (github.com/Toni-SM/skrl/issues/453).
        return 4 * torch.rand(len(inputs["observations"]), 1) - 2, {}


class Critic(Network):
    def compute(self, inputs, role=""):
        return self.layers(torch.cat([inputs["observations"], inputs["taken_actions"]], dim=1)), {}


def main(steps: int = 10_000, seed: int = 0) -> list[float]:
    """Train. Gives the mean returns of the first ten episodes and of the last ten."""
    torch.set_num_threads(1)
    set_seed(seed)
    makers = [lambda: lare_rl.EpisodicReward(gymnasium.make("Pendulum-v1"))] * 2
    envs = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)  # every row is a step
    envs = RecordEpisodeStatistics(envs, buffer_length=steps)
    observations, actions = envs.single_observation_space, envs.single_action_space
    credit = lare_rl.CreditAssigner("bayes", observation_space=observations, action_space=actions)
    env = wrap_env(VectorCredit(envs, credit, pay="environment"), verbose=False)

    memory = CreditMemory(credit, memory_size=50_000, num_envs=2)
    models = {name: Actor(env, 3) for name in ("policy", "target_policy")}
    models |= {name: Critic(env, 4) for name in ("critic_1", "critic_2", "target_critic_1", "target_critic_2")}
    settings = TD3_CFG(
        batch_size=128,
        gradient_steps=2,
        discount_factor=0.98,
        random_timesteps=500,
        learning_starts=500,
        exploration_noise=GaussianNoise,
        exploration_noise_kwargs={"mean": 0, "std": 0.2},
        smooth_regularization_noise=GaussianNoise,
        smooth_regularization_noise_kwargs={"mean": 0, "std": 0.2},
        experiment={"write_interval": 0, "checkpoint_interval": 0},  # pyright: ignore[reportArgumentType]
    )
    agent = CreditTD3(models=models, memory=memory, cfg=settings, observation_space=observations, action_space=actions)
    trainer = {
        "timesteps": steps // 2,
        "headless": True,
        "disable_progressbar": True,
        "close_environment_at_exit": False,
    }
    SequentialTrainer(env=env, agents=agent, cfg=trainer).train()
    env.close()

    played = np.array(envs.return_queue)
    returns = [float(played[:10].mean()), float(played[-10:].mean())]
    print(f"mean return of the first and of the last ten episodes: {returns[0]:.0f}, {returns[1]:.0f}")
    print(credit.metrics())
    return returns


if __name__ == "__main__":
    tyro.cli(main)

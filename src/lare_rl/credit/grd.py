"""GRD: generative return decomposition (Zhang et al., NeurIPS 2023, arXiv 2305.18427).

A causal model of rewards and of next states. A mask C says which entries of the state s and of the action a are causes:

    r_hat_t   = f(C_sr * s_t, C_ar * a_t)
    s_{i,t+1} ~ sum_k pi_k N(mu_k, sigma_k^2),    k = 1..3,    (pi, mu, sigma) = g(C_ss[:, i] * s_t, C_as[:, i] * a_t)

Each possible cause has two logits, whose difference is d. It is a cause if d > 0. In an update, C is one hard sample of a Gumbel
sigmoid, with the gradient of the soft one (Jang, Gu and Poole, 2017):

    c = sigmoid((d + logistic noise) / 0.01),    C = 1 if c > 1/2, else 0

    loss = (mean_t r_hat_t - R/T)^2           +  lambda_sr E softplus(d_sr) + lambda_ar E softplus(d_ar)
           - E_{t,i} log p(s_{i,t+1})         +  lambda_ss E_{i != j} softplus(d_ss[i, j]) + lambda_ii E_i softplus(d_ss[i, i])
                                              +  lambda_as E softplus(d_as)

softplus(d) is -log of the probability that C is 0: it asks for sparsity. As long as the loss at the left of a line exceeds a
threshold (1e-4 of the rewards, 1/2 of the next states), the sparsity at its right is left out.

Masks of next states do not change r_hat. In the paper they choose the entries that the policy sees, which is not done here. The
equations and settings are those of the authors' code, not of the paper; docs/reference/differences.md lists the differences.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from lare_rl.credit.decoder_network import DecoderOutput
from lare_rl.credit.losses import EpisodeInputs, EpisodeLengths, PerEpisode
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn.masks import masked_mean, step_mask
from lare_rl.nn.networks import MLP, bound_log_std

__all__ = ["GRD", "causes", "sample_mask"]

TEMPERATURE = 0.01
COMPONENTS = 3
"""The number of Gaussians in the mixture of a next state's entry."""
DYNAMICS_STEPS = 256
"""The number of steps, drawn from an update's episodes, whose next states are predicted."""
REWARD_THRESHOLD, DYNAMICS_THRESHOLD = 1e-4, 0.5
"""A sparsity term counts while the loss beside it is at most this large."""


def causes(logits: Float[Array, "*edges 2"]) -> Bool[Array, "*edges"]:
    """Return which edges exist: those that are more probable than not."""
    return logits[..., 0] > logits[..., 1]


def sample_mask(logits: Float[Array, "*edges 2"], key: PRNGKeyArray) -> Float[Array, "*edges"]:
    """Return a sample of which edges exist, 1 or 0, with the gradient of the soft sample."""
    difference = logits[..., 0] - logits[..., 1]
    soft = jax.nn.sigmoid((difference + jax.random.logistic(key, difference.shape)) / TEMPERATURE)
    return soft + jax.lax.stop_gradient((soft > 0.5) - soft)


def _init_logits(*shape: int, key: PRNGKeyArray) -> Float[Array, "*edges 2"]:
    return jax.nn.initializers.glorot_uniform(batch_axis=tuple(range(len(shape) - 1)))(key, (*shape, 2))


class GRD(eqx.Module):
    """The masks, the reward model f and the model g of next states. Its inputs are s, a and the next s."""

    state_reward: Float[Array, "states 2"]
    """Logits of C_sr."""
    action_reward: Float[Array, "actions 2"]
    """Logits of C_ar."""
    state_state: Float[Array, "states states 2"]
    """Logits of C_ss. The second axis is that of the next state."""
    action_state: Float[Array, "actions states 2"]
    """Logits of C_as."""
    reward_model: MLP
    dynamics: MLP
    sparsity: tuple[float, ...] = eqx.field(static=True)
    """lambda_sr, lambda_ar, lambda_ss, lambda_ii and lambda_as."""

    def __init__(self, key: PRNGKeyArray, spec: CreditSpec):
        """Make an untrained model. Raises `LareError` if its inputs are not s, a and the next s."""
        n_states, n_actions, _ = spec.sizes("observation", "action", "next_observation")
        keys = jax.random.split(key, 6)
        self.state_reward = _init_logits(n_states, key=keys[0])
        self.action_reward = _init_logits(n_actions, key=keys[1])
        self.state_state = _init_logits(n_states, n_states, key=keys[2])
        self.action_state = _init_logits(n_actions, n_states, key=keys[3])
        self.reward_model = MLP(n_states + n_actions, spec.settings.hidden, 1, key=keys[4])
        self.dynamics = MLP(n_states + n_actions, spec.settings.hidden, 3 * COMPONENTS, key=keys[5])
        self.sparsity = spec.settings.sparsity

    def _split(self, inputs: Float[Array, "*rows inputs"]) -> list[Float[Array, "*rows entries"]]:
        """Return s, a and the next s."""
        n_states = len(self.state_reward)
        return jnp.split(inputs, [n_states, n_states + len(self.action_reward)], axis=-1)

    def _reward(
        self,
        inputs: Float[Array, "*rows inputs"],
        state_mask: Float[Array, " states"] | Bool[Array, " states"],
        action_mask: Float[Array, " actions"] | Bool[Array, " actions"],
    ) -> Float[Array, "*rows"]:
        state, action, _ = self._split(inputs)
        return self.reward_model(jnp.concatenate([state_mask * state, action_mask * action], axis=-1))[..., 0]

    def __call__(self, inputs: Float[Array, "rows *agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        """Return f of the causes."""
        return DecoderOutput(self._reward(inputs, causes(self.state_reward), causes(self.action_reward)))

    def next_state_log_density(
        self,
        inputs: Float[Array, "rows inputs"],
        state_mask: Float[Array, "states states"],
        action_mask: Float[Array, "actions states"],
    ) -> Float[Array, "states rows"]:
        """Return log p of each entry of the next states."""
        state, action, next_state = self._split(inputs)
        masked = [mask.T[:, None] * x for mask, x in ((state_mask, state), (action_mask, action))]
        log_weight, mean, log_std = jnp.split(self.dynamics(jnp.concatenate(masked, axis=-1)), 3, axis=-1)
        log_std = bound_log_std(log_std)
        error = (next_state.T[..., None] - mean) * jnp.exp(-log_std)
        log_density = -0.5 * error**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
        return jax.nn.logsumexp(jax.nn.log_softmax(log_weight) + log_density, axis=-1)

    def loss(
        self, inputs: EpisodeInputs, length: EpisodeLengths, target: PerEpisode, mask: PerEpisode, key: PRNGKeyArray
    ) -> Float[Array, ""]:
        """Return the loss. The arguments are those of `Diaster.loss`. `key` is also for the steps whose next states are predicted."""
        keys = jax.random.split(key, 5)
        lambda_sr, lambda_ar, lambda_ss, lambda_ii, lambda_as = self.sparsity
        valid = step_mask(length, inputs.shape[1]) & (mask > 0)[:, None]
        r_hat = self._reward(inputs, sample_mask(self.state_reward, keys[0]), sample_mask(self.action_reward, keys[1]))
        error = jnp.sum(valid * r_hat, axis=1) / jnp.maximum(length, 1) - target
        reward_loss = masked_mean(error**2, mask)
        reward_sparsity = lambda_sr * _mean_sparsity(self.state_reward) + lambda_ar * _mean_sparsity(self.action_reward)

        n_valid, rows = jnp.sum(valid), inputs.reshape(-1, inputs.shape[-1])
        row_index = jax.random.choice(keys[2], len(rows), (DYNAMICS_STEPS,), p=valid.ravel() / jnp.maximum(n_valid, 1))
        masks = sample_mask(self.state_state, keys[3]), sample_mask(self.action_state, keys[4])
        dynamics_loss = -jnp.mean(self.next_state_log_density(rows[row_index], *masks))
        itself = jnp.eye(len(self.state_reward), dtype=bool)
        dynamics_sparsity = (
            lambda_ss * _mean_sparsity(self.state_state, ~itself)
            + lambda_ii * _mean_sparsity(self.state_state, itself)
            + lambda_as * _mean_sparsity(self.action_state)
        )
        dynamics = dynamics_loss + (dynamics_loss <= DYNAMICS_THRESHOLD) * dynamics_sparsity
        return reward_loss + (reward_loss <= REWARD_THRESHOLD) * reward_sparsity + jnp.where(n_valid > 0, dynamics, 0)


def _mean_sparsity(logits: Float[Array, "*edges 2"], selected: Bool[Array, "*edges"] | None = None) -> Float[Array, ""]:
    """Return the mean of -log P(C = 0) over the selected edges; 0 if there are none."""
    negative_log = jax.nn.softplus(logits[..., 0] - logits[..., 1])
    return masked_mean(negative_log, selected)

"""RBT: the reward bag transformer (Tang et al., Reinforcement learning from bagged reward, TMLR 2025, arXiv 2402.03771).

A bag is the steps that one payment is for. A causal transformer reads its actions and states, two tokens for each step, in the order
a_0, s_0, a_1, s_1, ... Its outputs are h_t at s_t and g_t at a_t. The steps of a bag then attend to each other in both directions:

    r_t = sum_u softmax_u(q_t k_u / sqrt(size)) v_u,    [q_t, k_t, v_t] = A h_t,    v_t is one number
    (sum_t r_t - R)^2 / T  +  mean_{t,i} (B g_t - s_{t+1})_i^2

The transformer is GPT-2 (Radford et al., 2019): x + attention(LN(x)), then x + F2 relu(F1 LN(x)), three times, with a tenth of
all activations dropped in an update. It cannot judge a single stored step, so that a step model learns r_t from s_t and a_t: see
`losses.step_loss`. r_t is in units of the scale, the root mean square of R/T.

The equations and settings are those of the authors' code, not of the paper; docs/reference/differences.md lists the differences.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from lare_rl.credit.decoder_network import DecoderOutput, split_key
from lare_rl.credit.decoders import RBT_STEPS
from lare_rl.credit.losses import EpisodeInputs, EpisodeLengths, PerEpisode, step_loss
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn.attention import LayerNorm, attend, causal_mask
from lare_rl.nn.dropout import dropout
from lare_rl.nn.masks import masked_mean, step_mask
from lare_rl.nn.networks import MLP, Linear

__all__ = ["RBT", "Block"]

LAYERS = 3
DROPOUT = 0.1
"""The probability that an activation is dropped in an update."""


class Block(eqx.Module):
    """A layer of GPT-2 with one head."""

    norms: tuple[LayerNorm, LayerNorm]
    projections: Linear
    """To query, key and value side by side."""
    merge: Linear
    feed_forward: MLP

    def __init__(self, size: int, *, key: PRNGKeyArray):
        keys = jax.random.split(key, 3)
        self.norms = LayerNorm(size), LayerNorm(size)
        self.projections = Linear(size, 3 * size, key=keys[0])
        self.merge = Linear(size, size, key=keys[1])
        self.feed_forward = MLP(size, (4 * size,), size, key=keys[2])

    def __call__(
        self, x: Float[Array, "episodes tokens size"], key: PRNGKeyArray | None
    ) -> Float[Array, "episodes tokens size"]:
        keys = split_key(key, 3)
        query, projected_key, value = jnp.split(self.projections(self.norms[0](x))[..., None, :], 3, axis=-1)
        attended = attend(
            query, projected_key, value, causal_mask(x.shape[1]), partial(dropout, key=keys[0], rate=DROPOUT)
        )
        x = x + dropout(self.merge(attended), keys[1], DROPOUT)
        return x + dropout(self.feed_forward(self.norms[1](x)), keys[2], DROPOUT)


def _positions(n_steps: int, size: int) -> Float[Array, "steps size"]:
    """Return sines and cosines of the numbers of the steps (Vaswani et al., 2017)."""
    angle = jnp.arange(n_steps)[:, None] * 1e4 ** (-2 * (jnp.arange(size) // 2) / size)
    return jnp.where(jnp.arange(size) % 2 == 0, jnp.sin(angle), jnp.cos(angle))


class RBT(eqx.Module):
    """The transformer and the step model. Its inputs are s, a and the next s."""

    embed_state: Linear
    embed_action: Linear
    first_norm: LayerNorm
    blocks: tuple[Block, ...]
    last_norm: LayerNorm
    bag_attention: Linear
    """A: to query, key and value of the attention in both directions."""
    next_state: Linear
    """B"""
    step_model: MLP

    def __init__(self, key: PRNGKeyArray, spec: CreditSpec):
        """Make an untrained model. Raises `LareError` if its inputs are not s, a and the next s."""
        n_states, n_actions, _ = spec.sizes("observation", "action", "next_observation")
        size, keys = spec.settings.hidden[0], jax.random.split(key, 5 + LAYERS)
        self.embed_state = Linear(n_states, size, key=keys[0])
        self.embed_action = Linear(n_actions, size, key=keys[1])
        self.first_norm, self.last_norm = LayerNorm(size), LayerNorm(size)
        self.bag_attention = Linear(size, 2 * size + 1, key=keys[2])
        self.next_state = Linear(size, n_states, key=keys[3])
        self.step_model = MLP(n_states + n_actions, spec.settings.hidden, 1, key=keys[4])
        self.blocks = tuple(Block(size, key=block_key) for block_key in keys[5:])

    def _split(self, inputs: Float[Array, "*rows inputs"]) -> list[Float[Array, "*rows entries"]]:
        """Return s, a and the next s."""
        n_states, n_actions = (layer.weight.shape[0] for layer in (self.embed_state, self.embed_action))
        return jnp.split(inputs, [n_states, n_states + n_actions], axis=-1)

    def _step_inputs(self, inputs: Float[Array, "*rows inputs"]) -> Float[Array, "*rows entries"]:
        return jnp.concatenate(self._split(inputs)[:2], axis=-1)

    def __call__(self, inputs: Float[Array, "rows *agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        return DecoderOutput(self.step_model(self._step_inputs(inputs))[..., 0])

    def bag_rewards(
        self, inputs: Float[Array, "bags steps inputs"], valid: Bool[Array, "bags steps"], key: PRNGKeyArray | None
    ) -> tuple[Float[Array, "bags steps"], Float[Array, "bags steps states"]]:
        """Return r_t and the predicted next states of each bag. Without a key, no activation is dropped."""
        state, action, _ = self._split(inputs)
        keys = split_key(key, 1 + LAYERS)
        position = _positions(inputs.shape[1], self.embed_state.weight.shape[1])
        tokens = jnp.stack([self.embed_action(action) + position, self.embed_state(state) + position], axis=2)
        x = self.first_norm(tokens.reshape(len(inputs), -1, tokens.shape[-1]))
        x = dropout(x, keys[0], DROPOUT)
        for block, block_key in zip(self.blocks, keys[1:], strict=True):
            x = block(x, block_key)
        x = self.last_norm(x).reshape(tokens.shape)
        at_action, at_state = x[:, :, 0], x[:, :, 1]
        size = x.shape[-1]
        query, bag_key, value = jnp.split(self.bag_attention(at_state), [size, 2 * size], axis=-1)
        scores = jnp.where(valid[:, None], query @ jnp.swapaxes(bag_key, 1, 2) / jnp.sqrt(size), -1e9)
        return (jax.nn.softmax(scores) @ value)[..., 0], self.next_state(at_action)

    def loss(
        self, inputs: EpisodeInputs, length: EpisodeLengths, target: PerEpisode, mask: PerEpisode, key: PRNGKeyArray
    ) -> Float[Array, ""]:
        """Return the loss of the transformer plus that of the step model.

        The arguments are those of `Diaster.loss`, for bags of at most `RBT_STEPS` steps.
        """
        max_steps, n_steps = inputs.shape[1], jnp.maximum(length, 1)
        assert max_steps <= RBT_STEPS
        valid = step_mask(length, max_steps)
        reward, next_state = self.bag_rewards(inputs, valid, key)
        reward = valid * reward
        reward_loss = (jnp.sum(reward, axis=1) - target * length) ** 2 / n_steps
        squared_error = jnp.mean((next_state - self._split(inputs)[2]) ** 2, axis=-1)
        state_loss = jnp.sum(valid * squared_error, axis=1) / n_steps
        prefix = jnp.cumsum(reward, axis=1) / max_steps
        loss = reward_loss + state_loss + step_loss(self.step_model, self._step_inputs(inputs), prefix, length)
        return masked_mean(loss, mask)

"""TAR2: temporal-agent reward redistribution (Kapoor et al., 2025, arXiv 2502.04864).

Three times, causal attention over the steps of each agent is followed by attention over the agents of each step under random
coalitions, both as in STAS. The outputs of all layers, h, and the outcome of the episode give contributions. Their mean is fitted to
R/T. The states and the past must tell which action an agent takes next:

    c_{i,t} = `CreditSpec.output_scale` * MLP([h_{i,t}, mean_j h_{j,T-1}]),    no gradient through the second one
    p(a_{i,t}) = softmax(MLP([mean_j e_{j,t}, h_{i,t-1}])),    h_{i,-1} = 0
    (mean_{i,t} c_{i,t} - R/T)^2 - 0.05 mean_{i,t} log p(a_{i,t})

e is the embedding of an observation and its position. The rewards of an episode are not c, but shares of the return
(`return_shares`).

The network, the loss and the settings are those of the authors' code, not of the paper; docs/reference/differences.md lists the
differences.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from lare_rl.credit.decoder_network import DecoderOutput
from lare_rl.credit.spec import CreditSpec
from lare_rl.credit.stas import Coalitions, TimeLayer, gelu, mean_over_samples
from lare_rl.nn.networks import MLP, Linear

__all__ = ["TAR2", "pay_shares", "return_shares"]

SIZE, LAYERS = 64, 3
"""The width of a token, and the number of pairs of layers."""
ACTION_WEIGHT = 0.05
"""The weight of the predicted actions beside the squared error."""


class TAR2(eqx.Module):
    """The authors' network, layer by layer. Its inputs are an observation and a one-hot action."""

    embed_observation: Linear
    embed_action: Linear
    position: Float[Array, "steps size"]
    index_embeddings: Float[Array, "layers agents size"]
    time_layers: tuple[TimeLayer, ...]
    agent_layers: tuple[Coalitions, ...]
    contribution_model: MLP
    action_model: MLP
    output_scale: float = eqx.field(static=True)

    def __init__(self, key: PRNGKeyArray, spec: CreditSpec):
        """Make an untrained network. Raises `LareError` if its inputs are not observation and action."""
        n_observations, n_actions = spec.sizes("observation", "action")
        self.output_scale = spec.output_scale
        keys = jax.random.split(key, 8)
        self.embed_observation = Linear(n_observations, SIZE, key=keys[0])
        self.embed_action = Linear(n_actions, SIZE, key=keys[1])
        self.position = jax.random.normal(keys[2], (spec.max_steps, SIZE))
        self.index_embeddings = jax.random.normal(keys[3], (LAYERS, spec.agents, SIZE))
        self.time_layers = tuple(TimeLayer(SIZE, key=key) for key in jax.random.split(keys[4], LAYERS))
        self.agent_layers = tuple(Coalitions(spec.agents, SIZE, key=key) for key in jax.random.split(keys[5], LAYERS))
        self.contribution_model = MLP(2 * LAYERS * SIZE, (SIZE,), 1, key=keys[6], activation=gelu)
        self.action_model = MLP((1 + LAYERS) * SIZE, (SIZE,), n_actions, key=keys[7], activation=gelu)

    def __call__(self, inputs: Float[Array, "rows agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        """Return the contributions. Without a key, they are means over fixed samples of coalitions and orders of index embeddings."""
        shape = -1, len(self.position), inputs.shape[1]
        observation, action = jnp.split(inputs, [self.embed_observation.weight.shape[0]], axis=-1)
        state = self.embed_observation(observation).reshape(*shape, SIZE) + self.position[:, None]
        tokens = state + self.embed_action(action).reshape(*shape, SIZE)
        if key is None:
            mean = mean_over_samples(lambda key: self._contributions(self._attend(tokens, key)))
            return DecoderOutput(self.output_scale * mean.reshape(inputs.shape[:2]))
        h = self._attend(tokens, key)
        past = jnp.pad(h[:, :-1], ((0, 0), (1, 0), (0, 0), (0, 0)))
        mean_state = jnp.broadcast_to(jnp.mean(state, axis=2, keepdims=True), state.shape)
        log_p = jax.nn.log_softmax(self.action_model(jnp.concatenate([mean_state, past], axis=-1)))
        # Standardised or not, the largest entry of a one-hot action is the one of the action that was taken.
        chosen = jnp.argmax(action, axis=-1).reshape(*shape, 1)
        penalty = -ACTION_WEIGHT * jnp.take_along_axis(log_p, chosen, axis=-1)
        r_hat = self.output_scale * self._contributions(h)
        return DecoderOutput(r_hat.reshape(inputs.shape[:2]), penalty.reshape(inputs.shape[:2]))

    def _attend(
        self, x: Float[Array, "episodes steps agents size"], key: PRNGKeyArray
    ) -> Float[Array, "episodes steps agents stacked"]:
        """Return the outputs of all layers, for one sample of coalitions and of the order of index embeddings for each layer."""
        outputs = []
        layers = self.time_layers, self.agent_layers, self.index_embeddings, jax.random.split(key, LAYERS)
        for time_layer, agent_layer, index_embeddings, layer_key in zip(*layers, strict=True):
            x = jnp.swapaxes(time_layer(jnp.swapaxes(x, 1, 2), None), 1, 2)
            x = agent_layer(x, index_embeddings, layer_key, None)
            outputs.append(x)
        return jnp.concatenate(outputs, axis=-1)

    def _contributions(self, h: Float[Array, "episodes steps agents stacked"]) -> Float[Array, "episodes steps agents"]:
        outcome = jax.lax.stop_gradient(jnp.mean(h[:, -1:], axis=2, keepdims=True))
        return self.contribution_model(jnp.concatenate([h, jnp.broadcast_to(outcome, h.shape)], axis=-1))[..., 0]


def pay_shares(
    contributions: Float[Array, "*batch agents"],
    alive: Bool[Array, "*batch agents"],
    returns: Float[Array, "*batch"],
    max_steps: int,
) -> Float[Array, "*batch agents"]:
    """Return what each agent is paid at each step: its share of the return. All episodes have `max_steps` steps, and are whole.

    The mean over the agents that are alive is the share of the step, and R is the sum of these means.
    """
    shares = return_shares(*(values.reshape(-1, max_steps, values.shape[-1]) for values in (contributions, alive)))
    return shares.reshape(contributions.shape) * (returns * jnp.sum(alive, axis=-1))[..., None]


def return_shares(
    contributions: Float[Array, "episodes steps agents"], alive: Bool[Array, "episodes steps agents"]
) -> Float[Array, "episodes steps agents"]:
    """Return the share of each agent at each step, by the deterministic normalisation of contributions c_{i,t}.

    Those of the steps, and those of the agents of a step, become weights that add up to 1:

        w_t     = (C_t - min C) / sum_u (C_u - min C),              C_t = sum_i c_{i,t}
        w_{i,t} = (c_{i,t} - min_j c_{j,t}) / sum_j (c_{j,t} - min_k c_{k,t})

    The share of agent i at step t is w_t w_{i,t}. The shares of an episode add up to 1 whatever the contributions are, so that the
    rewards share * R add up to the return. Only agents that are alive have a share. Equal contributions have equal weights.
    """
    step_contribution = jnp.sum(jnp.where(alive, contributions, 0), axis=-1)
    step_weight = _weights(step_contribution, jnp.any(alive, axis=-1))
    return step_weight[..., None] * _weights(contributions, alive)


def _weights(values: Float[Array, "*batch size"], mask: Bool[Array, "*batch size"]) -> Float[Array, "*batch size"]:
    """Return weights over the last axis that add up to 1: how much each value exceeds the least one. 0 where `mask` is false."""
    lowest = jnp.min(jnp.where(mask, values, jnp.inf), axis=-1, keepdims=True)
    excess = jnp.where(mask, values - lowest, 0)
    total = jnp.sum(excess, axis=-1, keepdims=True)
    equal = mask / jnp.maximum(jnp.sum(mask, axis=-1, keepdims=True), 1)
    return jnp.where(total > 0, excess / jnp.where(total > 0, total, 1), equal)

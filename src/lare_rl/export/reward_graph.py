"""The proxy rewards of a team as a graph: from steps to r_hat, in the unit of the true rewards.

    before, after [batch *agents observation]       observations before and after a step
    action [batch *agents action]                   in the environment's units; a choice is a one-hot row
    length [batch *one]                             T of the step's episode, if the score is a mean over its steps
    ->  r_hat [batch *agents]

The graph has only the inputs that the method uses, and the graph of phi is a part of it. If credit is assigned by the global state,
`before` and `after` are states, `action` holds the actions of all agents side by side, and there is one r_hat for the team.
"""

from typing import Any

import numpy as np

from lare_rl.credit.basis import HALF_PERIOD, N_FREQUENCIES, Basis
from lare_rl.credit.closed_form import LinearDecoder
from lare_rl.credit.decoders import DECODERS
from lare_rl.credit.decomposition import Decomposition, is_normalised, reward_unit
from lare_rl.credit.input_names import input_arrays
from lare_rl.credit.methods import Method, Reward
from lare_rl.credit.step_decoders import Bottleneck, StepDecoder
from lare_rl.export.layers import finish, first_outputs, graph_input, network, numpy_op, standardize
from lare_rl.nn.normalise import CLIP, running_std
from lare_rl.phi.arrays import Array, elementwise
from lare_rl.phi.builder import Builder, building, current_builder, inline
from lare_rl.phi.graph import Graph
from lare_rl.phi.limits import UNLIMITED
from lare_rl.tasks.spec import select_states
from lare_rl.training.static_config import TrainConfig

__all__ = ["missing_reward_reason", "reward_graph"]


def missing_reward_reason(method: Method) -> str | None:
    """Return why a method's rewards cannot be exported, or None if they can be."""
    if not method.has_proxy_rewards:
        return f"{method.name} trains on the rewards of the environment"
    if method.reward is Reward.UNIFORM:
        return f"{method.name} takes the reward of a step from the return of its episode"
    if method.inputs is not None and "history" in method.inputs.names:
        return f"{method.name} takes the reward of a step from the history of its episode"
    if method.reward is Reward.PROXY and not DECODERS[method.decoder].exportable:
        return f"the decoder of {method.name} ({method.decoder}) cannot be exported"
    return None


def reward_graph(credit: Decomposition | None, config: TrainConfig, team_index: int, phi: Graph | None = None) -> Graph:
    """Return the graph of a team's proxy rewards, without optimism.

    Args:
        credit: the decoder of one seed, or None if phi itself is the reward.
        config: the configuration of its run.
        team_index: the index of the team.
        phi: the graph of the team's phi, if the method has one.
    """
    team = config.env.teams[team_index]
    rows = () if config.team_level or team.n_agents == 1 else (team.n_agents,)
    with building(Builder(UNLIMITED)):
        inputs = input_arrays(config.credit_specs[team_index].inputs, _StepInputs(config, rows, team_index, phi))
        x = numpy_op("concatenate", inputs, axis=-1) if len(inputs) > 1 else inputs[0]
        if credit is None:
            r_hat = x[..., 0]
        else:
            r_hat = _decode(x, credit, config)
            if bool(credit.is_mean):
                r_hat = r_hat / graph_input("length", (1,) if rows else ())
        if config.method.shared and rows:
            r_hat = _team_mean(r_hat, rows, config)
        return finish(r_hat=r_hat)


class _StepInputs(dict[str, Any]):
    """The decoder's inputs of a step, by their names in `credit/input_names.py`; `before`, `after` and `env_action` are graph inputs.

    An input is added to the graph when it is first read.
    """

    def __init__(self, config: TrainConfig, rows: tuple[int, ...], team_index: int, phi: Graph | None):
        super().__init__()
        self.config, self.rows, self.team_index, self.phi = config, rows, team_index, phi

    def __missing__(self, name: str) -> Any:
        match name:
            case "factors":
                self[name] = self._factors()
            case "action":
                self[name] = self._action()
            case "observation" | "next_observation":
                self[name] = self["before" if name == "observation" else "after"]
            case "env_action":
                n_agents = self.config.env.n_agents if self.config.team_level else 1
                self[name] = graph_input("action", (*self.rows, n_agents * self.config.env.action_size))
            case _:
                self[name] = graph_input(name, (*self.rows, self.config.observed_size))
        return self[name]

    def _action(self) -> Any:
        """Return the action as the policy's networks see it, from the action in the environment's units."""
        env, action = self.config.env, self["env_action"]
        if env.discrete:
            return action
        agents = slice(None) if self.config.team_level else env.teams[self.team_index].agents
        low, high = (bound[agents].reshape((*self.rows, -1)) for bound in (env.low, env.high))
        return numpy_op("clip", standardize(action, (low + high) / 2, (high - low) / 2), -1.0, 1.0)

    def _factors(self) -> Any:
        """Return the factors of a step, for each agent by itself."""
        assert self.phi is not None
        factors = []
        for side in select_states(self.config.scored_observation, "before", "after"):
            nodes = {"observation": self[side].node, "action": self["env_action"].node}
            node = inline(current_builder(), self.phi, nodes, self.rows[0] if self.rows else None)["factors"]
            factors.append(Array(node, None))
        return numpy_op("concatenate", factors, axis=-1) if len(factors) > 1 else factors[0]


def _decode(x: Array, credit: Decomposition, config: TrainConfig) -> Any:
    """Return the decoder's output for a step, in the unit of the true rewards."""
    decoder = credit.network
    if isinstance(decoder, LinearDecoder):
        return _linear_reward(x, decoder)
    if is_normalised(credit, config.credit):
        x = standardize(x, credit.statistics.mean, running_std(credit.statistics), CLIP)
    if isinstance(decoder, Bottleneck):
        x = network(x, first_outputs(decoder.encoder, decoder.encoder.layers[-1].weight.shape[1] // 2))
        decoder = decoder.step_decoder
    assert isinstance(decoder, StepDecoder)
    scale = float(reward_unit(credit, config.credit)) * float(decoder.gain)
    return network(x, decoder.mlp)[..., 0] * scale


def _linear_reward(x: Array, decoder: LinearDecoder) -> Any:
    """Return r_hat = b + w . f(u), one group of features after the other. The groups are those of `credit/basis.py`."""
    basis: Basis = decoder.basis
    ends = np.cumsum(list(basis.group_sizes.values()))[:-1]
    weights = dict(zip(basis.group_sizes, np.split(np.asarray(decoder.weight, np.float32), ends), strict=True))
    u = standardize(x, decoder.mean, decoder.std)
    clipped = numpy_op("clip", u, -HALF_PERIOD, HALF_PERIOD)
    factors, raw = slice(0, basis.n_factors), slice(basis.n_factors, basis.n_factors + basis.n_raw_used)
    linear = np.zeros(basis.n_inputs, np.float32)
    linear[factors], linear[raw] = weights.get("factors", 0), weights.get("raw features", 0)
    r_hat = numpy_op("matmul", u, linear) + float(decoder.bias)
    waves = np.zeros((N_FREQUENCIES, 2, basis.n_inputs), np.float32)
    for name, columns in (("shapes of factors", factors), ("shapes of raw features", raw)):
        if name in weights:
            group = weights[name].reshape(-1, 2, columns.stop - columns.start)
            waves[: len(group), :, columns] = group
    for k, (cosine, sine) in enumerate(waves, start=1):
        angle = clipped * (k * np.pi / HALF_PERIOD)
        for wave, weight in (("cos", cosine), ("sin", sine)):
            if weight.any():
                r_hat = r_hat + numpy_op("matmul", elementwise(wave, angle), weight / k)
    pairs = np.zeros((basis.n_inputs, basis.n_inputs), np.float32)
    for name, columns in (("pairs of factors", factors), ("pairs of raw features", raw)):
        if name in weights:
            size = columns.stop - columns.start
            pairs[columns, columns][np.triu_indices(size, 1)] = weights[name]
    if pairs.any():
        r_hat = r_hat + numpy_op("sum", clipped * numpy_op("matmul", clipped, pairs.T), axis=-1)
    return r_hat


def _team_mean(r_hat: Array, rows: tuple[int, ...], config: TrainConfig) -> Any:
    """Return the mean over the agents. If agents may leave, it is the mean over the agents that are alive, and 0 for the others."""
    if not config.env.agents_leave:
        return numpy_op("broadcast_to", numpy_op("mean", r_hat, axis=-1, keepdims=True), rows)
    alive = graph_input("alive", rows)
    count = elementwise("maximum", numpy_op("sum", alive, axis=-1, keepdims=True), 1.0)
    return numpy_op("sum", r_hat * alive, axis=-1, keepdims=True) / count * alive  # pyright: ignore

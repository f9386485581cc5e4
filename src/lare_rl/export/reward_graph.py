"""The proxy rewards of a team as a graph: from steps to r_hat, in the unit of the true rewards.

    before, after [batch *agents observation]       observations before and after a step
    action [batch *agents action]                   in the environment's units; a choice is a one-hot row
    length [batch *one]                             T of the step's episode, if the score is an average over its steps
    ->  r_hat [batch *agents]

The graph has only the inputs that the method uses, and the graph of phi is a part of it. If credit is judged from the global state,
`before` and `after` are states, `action` holds the actions of all agents side by side, and there is one r_hat for the team.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from lare_rl.credit.basis import FREQUENCIES, HALF_PERIOD, Basis
from lare_rl.credit.closed_form import LinearDecoder
from lare_rl.credit.decoders import Bottleneck, StepDecoder
from lare_rl.credit.decomposition import Decomposition, normalised, unit
from lare_rl.credit.methods import Encoder, Reward
from lare_rl.export.layers import finish, graph_input, network, numpy, standardize
from lare_rl.export.policy_graph import first_outputs
from lare_rl.nn.normalise import CLIP, deviation
from lare_rl.phi.arrays import Array, elementwise
from lare_rl.phi.graph import UNLIMITED, Builder, Graph, building, current_builder
from lare_rl.tasks.spec import judged_states
from lare_rl.training.static_config import TrainConfig

STEP_DECODERS = (StepDecoder, Bottleneck, LinearDecoder)
"""Decoders whose proxy reward depends on a single step alone. Other decoders look at whole episodes."""


def unexported(config: TrainConfig, decoder: object | None) -> str | None:
    """Why a method's rewards are not a function of a single step; None if they are."""
    method = config.method
    if not method.has_proxy:
        return f"{method.name} trains on what the environment pays"
    if method.reward is Reward.UNIFORM:
        return f"{method.name} pays by the return of a step's episode"
    if method.reward is Reward.PROXY and not isinstance(decoder, STEP_DECODERS):
        return f"{method.name} looks at whole episodes, not at steps"
    return None


def reward_graph(credit: Decomposition | None, config: TrainConfig, team_index: int, phi: Graph | None = None) -> Graph:
    """The graph of a team's proxy rewards, without optimism.

    Args:
        credit: the decoder of one seed; None if phi itself is the reward.
        config: the configuration of its run.
        team_index: the index of the team.
        phi: the graph of the team's phi, if the method has one.
    """
    team = config.env.teams[team_index]
    rows = () if config.of_state or team.size == 1 else (team.size,)
    with building(Builder(UNLIMITED)):
        inputs = _StepInputs(config, rows)
        features = [] if phi is None else _factors(phi, inputs, rows, config)
        features += _raw_features(inputs, config, rows, team_index)
        x = numpy("concatenate", features, axis=-1) if len(features) > 1 else features[0]
        if credit is None:
            r_hat = x[..., 0]
        else:
            r_hat = _decoded(x, credit, config)
            if bool(credit.average):
                r_hat = r_hat / graph_input("length", (1,) if rows else ())
        if config.method.shared and rows:
            r_hat = _shared(r_hat, rows, config)
        return finish(r_hat=r_hat)


class _StepInputs:
    """The input arrays of a step. An array becomes an input of the graph when it is first used."""

    def __init__(self, config: TrainConfig, rows: tuple[int, ...]):
        width = config.env.action_size * (config.env.agents if config.of_state else 1)
        self.sizes = {"before": config.shown, "after": config.shown, "action": width}
        self.rows = rows
        self._arrays: dict[str, Array] = {}

    def __getitem__(self, name: str) -> Array:
        if name not in self._arrays:
            self._arrays[name] = graph_input(name, (*self.rows, self.sizes[name]))
        return self._arrays[name]


def _factors(phi: Graph, inputs: _StepInputs, rows: tuple[int, ...], config: TrainConfig) -> list[Any]:
    """The factors of a step by phi, for each agent by itself."""
    factors = []
    for side in judged_states(config.judges, "before", "after"):
        nodes = {"observation": inputs[side].node, "action": inputs["action"].node}
        node = current_builder().inline(phi, nodes, rows[0] if rows else None)["factors"]
        factors.append(Array(node, None))
    return factors


def _raw_features(inputs: _StepInputs, config: TrainConfig, rows: tuple[int, ...], team_index: int) -> list[Any]:
    """The raw part of a decoder's input, as in `training/learner.py`."""
    encoder, env = config.method.encoder, config.env
    if encoder in (None, Encoder.LATENT):
        return []
    if encoder is Encoder.RAW and not config.raw_differences:
        return [inputs["after"]]
    if env.discrete:
        action: Callable[[], Any] = lambda: inputs["action"]  # noqa: E731
    else:
        agents = slice(None) if config.of_state else env.teams[team_index].agents
        low, high = (bound[agents].reshape((*rows, -1)) for bound in (env.low, env.high))

        def action() -> Any:
            return numpy("clip", standardize(inputs["action"], (low + high) / 2, (high - low) / 2), -1.0, 1.0)

    match encoder:
        case Encoder.RAW:
            return [inputs["before"], action(), inputs["before"] - inputs["after"]]  # pyright: ignore
        case Encoder.STATE_ACTION:
            return [inputs["before"], action()]
        case Encoder.JUDGED | Encoder.LATENT_AND_JUDGED:
            return [*(inputs[side] for side in judged_states(config.judges, "before", "after")), action()]
        case _:
            return [inputs["after"], action()]


def _decoded(x: Array, credit: Decomposition, config: TrainConfig) -> Any:
    """The decoder's output for a step, in the unit of the true rewards."""
    decoder = credit.decoder
    if isinstance(decoder, LinearDecoder):
        return _additive(x, decoder)
    if normalised(credit, config.credit):
        x = standardize(x, credit.statistics.mean, deviation(credit.statistics), CLIP)
    if isinstance(decoder, Bottleneck):
        x = network(x, first_outputs(decoder.encoder, decoder.encoder.layers[-1].weight.shape[1] // 2))
        decoder = decoder.decoder
    assert isinstance(decoder, StepDecoder)
    scale = float(unit(credit, config.credit)) * float(decoder.gain)
    return network(x, decoder.network)[..., 0] * scale


def _additive(x: Array, decoder: LinearDecoder) -> Any:
    """r_hat = b + w . f(u), one group of features after the other; the groups are those of `credit/basis.py`."""
    basis, weights = decoder.basis, _weights_by_group(decoder)
    u = standardize(x, decoder.mean, decoder.deviation)
    within = numpy("clip", u, -HALF_PERIOD, HALF_PERIOD)
    factors, entries = slice(0, basis.factors), slice(basis.factors, basis.factors + basis.used_entries)
    linear = np.zeros(basis.inputs, np.float32)
    linear[factors], linear[entries] = weights.get("factors", 0), weights.get("entries", 0)
    r_hat = numpy("matmul", u, linear) + float(decoder.bias)
    waves = np.zeros((FREQUENCIES, 2, basis.inputs), np.float32)
    for name, columns in (("shapes of factors", factors), ("shapes of entries", entries)):
        if name in weights:
            group = weights[name].reshape(-1, 2, columns.stop - columns.start)
            waves[: len(group), :, columns] = group
    for k, (cosine, sine) in enumerate(waves, start=1):
        angle = within * (k * np.pi / HALF_PERIOD)
        for wave, weight in (("cos", cosine), ("sin", sine)):
            if weight.any():
                r_hat = r_hat + numpy("matmul", elementwise(wave, angle), weight / k)
    pairs = np.zeros((basis.inputs, basis.inputs), np.float32)
    for name, columns in (("pairs of factors", factors), ("pairs of entries", entries)):
        if name in weights:
            size = columns.stop - columns.start
            pairs[columns, columns][np.triu_indices(size, 1)] = weights[name]
    if pairs.any():
        r_hat = r_hat + numpy("sum", within * numpy("matmul", within, pairs.T), axis=-1)
    return r_hat


def _weights_by_group(decoder: LinearDecoder) -> dict[str, np.ndarray]:
    """The weights of each group of features."""
    basis: Basis = decoder.basis
    ends = np.cumsum(list(basis.sizes.values()))
    return dict(zip(basis.sizes, np.split(np.asarray(decoder.weight, np.float32), ends[:-1]), strict=True))


def _shared(r_hat: Array, rows: tuple[int, ...], config: TrainConfig) -> Any:
    """The mean over the agents. If agents may leave, the mean over those that are alive, and 0 for the others."""
    if not config.env.agents_leave:
        return numpy("broadcast_to", numpy("mean", r_hat, axis=-1, keepdims=True), rows)
    alive = graph_input("alive", rows)
    count = elementwise("maximum", numpy("sum", alive, axis=-1, keepdims=True), 1.0)
    return numpy("sum", r_hat * alive, axis=-1, keepdims=True) / count * alive  # pyright: ignore

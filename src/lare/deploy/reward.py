"""The proxy rewards of a team as a graph: from steps to r_hat, in the unit of the true rewards.

    before, after [batch *agents observation]       observations before and after a step
    action [batch *agents action]                   in the environment's units; a choice is a one-hot row
    length [batch *one]                             T of the step's episode, if the score is an average over its steps
    ->  r_hat [batch *agents]

The graph has only the inputs that the method uses. `phi` is a part of the graph. If it cannot be translated (`phi.py`), its output
is an input instead: factors [batch *agents factors]. If credit is judged from the global state, `before` and `after` are states,
`action` holds the actions of all agents side by side, and there is one r_hat for the team.
"""

import numpy as np

from lare.credit.basis import FREQUENCIES, HALF_PERIOD, Basis
from lare.credit.closed_form import LinearDecoder
from lare.credit.decoders import Bottleneck, StepDecoder
from lare.credit.decomposition import Decomposition, normalised, unit
from lare.credit.methods import Encoder, Reward
from lare.deploy.graph import Graph
from lare.deploy.phi import factors
from lare.deploy.policy import first
from lare.deploy.rows import Rows, joined
from lare.latent.function import LatentFunction
from lare.normalise import CLIP, deviation
from lare.tasks.spec import judged_states
from lare.training.config import TrainConfig

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


def reward(
    credit: Decomposition | None,
    config: TrainConfig,
    place: int,
    phi: LatentFunction | None = None,
) -> Graph:
    """The graph of a team's proxy rewards, without optimism.

    Args:
        credit: the decoder of one seed; None if phi itself is the reward.
        config: the configuration of its run.
        place: the index of the team.
        phi: the function to make a part of the graph. Without it, the factors are an input, if the method needs any.

    Raises:
        Untranslatable: phi has code that cannot be translated.
    """
    graph, team = Graph(), config.env.teams[place]
    rows = () if config.of_state or team.size == 1 else (team.size,)
    seen = []
    if phi is not None:
        seen.append(of_phi(graph, phi, rows, config))
    elif config.method.latent:
        seen.append(graph.input("factors", (*rows, config.factors[place])))
    seen += raw(graph, config, rows, place)
    x = graph.apply("Concat", *seen, axis=-1) if len(seen) > 1 else seen[0]
    if credit is None:
        said = graph.apply("MatMul", x, np.ones(1, np.float32))
    else:
        said = decoded(graph, x, credit, config)
        if bool(credit.average):
            said = graph.apply("Div", said, graph.input("length", (1,) if rows else ()))
    if config.method.shared and rows:
        said = shared(graph, said, rows, config)
    graph.output("r_hat", said, rows)
    return graph


def of_phi(graph: Graph, phi: LatentFunction, rows: tuple[int, ...], config: TrainConfig) -> str:
    """The factors of steps by phi, for each agent by itself."""
    width, parts = action_width(config), []
    for which in judged_states(config.judges, "before", "after"):
        shown = graph.input(which, (*rows, config.shown))
        action = graph.input("action", (*rows, width))
        if rows:
            shown = graph.apply("Reshape", shown, np.array([-1, config.shown]))
            action = graph.apply("Reshape", action, np.array([-1, width]))
        given = Rows(graph, shown, (config.shown,)), Rows(graph, action, (width,))
        parts.append(factors(graph, phi.readable, *given))
    z = joined(parts, axis=1)
    return graph.apply("Reshape", z.name, np.array([-1, *rows, *z.shape])) if rows else z.name


def action_width(config: TrainConfig) -> int:
    """Numbers in the actions of a judged row."""
    return config.env.action_size * (config.env.agents if config.of_state else 1)


def raw(graph: Graph, config: TrainConfig, rows: tuple[int, ...], place: int) -> list[str]:
    """The raw part of a decoder's input, as in `training/learner.py`."""
    encoder, env = config.method.encoder, config.env
    if encoder in (None, Encoder.LATENT):
        return []
    shown = (*rows, config.shown)
    if encoder is Encoder.RAW and not config.raw_differences:
        return [graph.input("after", shown)]
    action = graph.input("action", (*rows, action_width(config)))
    if not env.discrete:
        bounds = (
            (env.low, env.high)
            if config.of_state
            else (env.low[env.teams[place].agents], env.high[env.teams[place].agents])
        )
        low, high = (bound.reshape((*rows, -1)) for bound in bounds)
        action = graph.clip(graph.standardised(action, (low + high) / 2, (high - low) / 2), -1, 1)
    match encoder:
        case Encoder.RAW:
            before, after = (graph.input(name, shown) for name in ("before", "after"))
            return [before, action, graph.apply("Sub", before, after)]
        case Encoder.STATE_ACTION:
            return [graph.input("before", shown), action]
        case Encoder.JUDGED | Encoder.LATENT_AND_JUDGED:
            return [*(graph.input(name, shown) for name in judged_states(config.judges, "before", "after")), action]
        case _:
            return [graph.input("after", shown), action]


def decoded(graph: Graph, x: str, credit: Decomposition, config: TrainConfig) -> str:
    """The decoder's output for a step, in the unit of the true rewards."""
    decoder = credit.decoder
    if isinstance(decoder, LinearDecoder):
        return additive(graph, x, decoder)
    if normalised(credit, config.credit):
        x = graph.standardised(x, credit.statistics.mean, deviation(credit.statistics), CLIP)
    if isinstance(decoder, Bottleneck):
        x = graph.network(x, first(decoder.encoder, decoder.encoder.layers[-1].weight.shape[1] // 2), "Relu")
        decoder = decoder.decoder
    assert isinstance(decoder, StepDecoder)
    size = np.float32(unit(credit, config.credit)) * np.float32(decoder.gain)
    # The product with a vector of length 1 removes the last axis.
    return graph.apply("MatMul", graph.network(x, decoder.network, "Relu"), np.full(1, size, np.float32))


def additive(graph: Graph, x: str, decoder: LinearDecoder) -> str:
    """r_hat = b + w . f(u), one group of features after the other; the groups are those of `credit/basis.py`."""
    basis, weights = decoder.basis, by_group(decoder)
    u = graph.standardised(x, decoder.mean, decoder.deviation)
    within = graph.clip(u, -HALF_PERIOD, HALF_PERIOD)
    factors, entries = slice(0, basis.factors), slice(basis.factors, basis.factors + basis.used_entries)
    linear = np.zeros(basis.inputs, np.float32)
    linear[factors], linear[entries] = weights.get("factors", 0), weights.get("entries", 0)
    said = graph.apply("Add", graph.apply("MatMul", u, linear), np.asarray(decoder.bias, np.float32))
    waves = np.zeros((FREQUENCIES, 2, basis.inputs), np.float32)
    for name, columns in (("shapes of factors", factors), ("shapes of entries", entries)):
        if name in weights:
            of_group = weights[name].reshape(-1, 2, columns.stop - columns.start)
            waves[: len(of_group), :, columns] = of_group
    for k, (cosine, sine) in enumerate(waves, start=1):
        angle = graph.apply("Mul", within, np.float32(k * np.pi / HALF_PERIOD))
        for wave, weight in (("Cos", cosine), ("Sin", sine)):
            if weight.any():
                said = graph.apply("Add", said, graph.apply("MatMul", graph.apply(wave, angle), weight / k))
    pairs = np.zeros((basis.inputs, basis.inputs), np.float32)
    for name, columns in (("pairs of factors", factors), ("pairs of entries", entries)):
        if name in weights:
            size = columns.stop - columns.start
            pairs[columns, columns][np.triu_indices(size, 1)] = weights[name]
    if pairs.any():
        products = graph.apply("Mul", within, graph.apply("MatMul", within, pairs.T))
        said = graph.apply("Add", said, graph.apply("MatMul", products, np.ones(basis.inputs, np.float32)))
    return said


def by_group(decoder: LinearDecoder) -> dict[str, np.ndarray]:
    """The weights of each group of features."""
    basis: Basis = decoder.basis
    ends = np.cumsum(list(basis.sizes.values()))
    return dict(zip(basis.sizes, np.split(np.asarray(decoder.weight, np.float32), ends[:-1]), strict=True))


def shared(graph: Graph, said: str, rows: tuple[int, ...], config: TrainConfig) -> str:
    """The mean over the agents. If agents may leave, the mean over those that are alive, and 0 for the others."""
    (agents,) = rows
    ones = np.ones((agents, agents), np.float32)
    if not config.env.agents_leave:
        return graph.apply("MatMul", said, ones / agents)
    there = graph.input("alive", rows)
    count = graph.apply("Max", graph.apply("MatMul", there, ones), np.float32(1))
    mean = graph.apply("Div", graph.apply("MatMul", graph.apply("Mul", said, there), ones), count)
    return graph.apply("Mul", mean, there)

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from helpers.assigner_episodes import SMALL_CREDIT
from helpers.long_tests import long_case
from lare_rl import CreditAssigner
from lare_rl.config.settings import Settings
from lare_rl.credit import input_names, methods
from lare_rl.credit.decoder_network import DecoderOutput
from lare_rl.credit.decoders import DECODERS, Decoder, register_decoder
from lare_rl.credit.methods import METHODS, Fit, Method, Reward, register_method
from lare_rl.errors import LareError


def test_rows_and_names():
    for method in METHODS.values():
        assert (method.reward is Reward.PROXY) == (method.fit is not None)
        assert (method.reward in (Reward.PROXY, Reward.DESIGNED)) == (method.inputs is not None)
        assert method.summary
        assert method.source
    fits = {"rd": Fit.ALL_STEPS, "rrd": Fit.SAMPLED_STEPS, "rrdu": Fit.SAMPLED_STEPS_UNBIASED}
    for name in (*fits, "lare-rd", "lare-rrdu"):
        inputs = methods.FACTORS if name.startswith("lare-") else methods.RAW
        assert (METHODS[name].inputs, METHODS[name].fit) == (inputs, fits[name.removeprefix("lare-")])
    for name, words in (("lare_rrdu", "'lare_rrdu' .*'lare-rrdu'"), ("", "dense, episodic, ")):
        with pytest.raises(LareError, match=words):
            METHODS.find(name)
    with pytest.raises(LareError, match=r"observation, .*'observations'"):
        input_names.InputNames(("observations",))
    with pytest.raises(LareError, match="history must be the last"):
        input_names.InputNames(("history", "action"))
    with pytest.raises(LareError, match="factors must be"):
        input_names.InputNames(("observation",), ("factors",))


class Squares(eqx.Module):
    """A decoder with a loss of its own."""

    weight: Float[Array, " inputs"]

    def __call__(self, inputs, key):
        return DecoderOutput(inputs**2 @ self.weight)

    def loss(self, inputs, length, target, mask, key):
        valid = jnp.arange(inputs.shape[1]) < length[:, None]
        mean = jnp.sum(self(inputs, key).r_hat * valid, axis=1) / length
        return jnp.mean(mask * (mean - target) ** 2)


@pytest.fixture
def registered(monkeypatch):
    """Names that are registered by a test are removed after it."""
    for registry in (DECODERS, METHODS):
        monkeypatch.setattr(registry, "_values", dict(registry._values))


def register(fit, init=lambda key, spec: Squares(spec.output_scale * jnp.ones(spec.n_inputs))):
    register_decoder(Decoder("mine", init))
    register_method(Method("mine", "mine", "this test", inputs=methods.RAW, fit=fit, decoder="mine"))


@pytest.mark.parametrize("fit", [Fit.ALL_STEPS, Fit.DECODER_LOSS, long_case(Fit.SAMPLED_STEPS_UNBIASED)])
def test_registered_method_is_trained(fit, registered):
    register(fit)
    assert Settings(method="mine").method == "mine"
    credit = CreditAssigner("mine", observation_space=2, action_space=1, settings=SMALL_CREDIT)
    random = np.random.default_rng(0)
    for _ in range(4):
        s, a, reward = random.normal(size=(10, 2)), random.normal(size=(10, 1)), random.normal(size=10)
        credit.add_episode(s, a, s + 1, reward)
    credit.fit(20)
    assert np.isfinite(credit.metrics()["credit/loss"])


def test_loss_of_a_decoder_is_for_a_single_agent(registered):
    """Steps of several agents would be mixed with each other: `loss` has an axis of steps, and none of agents."""
    register(Fit.DECODER_LOSS)
    with pytest.raises(LareError, match="mine assigns credit to a single agent, and the task has 2 agents"):
        CreditAssigner("mine", observation_space=2, action_space=1, agents=2, max_steps=5)


def test_decoder_with_functions_is_refused_in_one_line(registered):
    register(Fit.ALL_STEPS, lambda key, spec: eqx.nn.MLP(spec.n_inputs, 1, 4, 1, key=key))
    with pytest.raises(LareError, match=r"'mine' holds .* instead of eqx.nn.MLP.*, use lare_rl.nn.networks.MLP"):
        CreditAssigner("mine", observation_space=2, action_space=1)


@pytest.mark.parametrize("agents", [1, 2])
@pytest.mark.parametrize(
    ("fit", "call"),
    [
        (Fit.ALL_STEPS, lambda self, inputs, key: inputs @ self.weight),
        (Fit.ALL_STEPS, lambda self, inputs, key: DecoderOutput(inputs @ self.weight, 0.0)),
        (Fit.ALL_STEPS, lambda self, inputs, key: DecoderOutput(inputs)),
        (Fit.ALL_STEPS, lambda self, inputs, key: DecoderOutput((inputs @ self.weight).ravel())),
        (Fit.LIKELIHOOD, lambda self, inputs, key: DecoderOutput(inputs @ self.weight)),
        (Fit.LIKELIHOOD, lambda self, inputs, key: DecoderOutput(inputs @ self.weight, log_std=inputs)),
    ],
)
def test_output_of_a_decoder_is_checked(fit, call, agents, registered, monkeypatch):
    monkeypatch.setattr(Squares, "__call__", call)
    register(fit)
    with pytest.raises(LareError, match=rf"'mine' must return DecoderOutput.* both of the shape \(2, {agents}\) for "):
        CreditAssigner("mine", observation_space=2, action_space=1, agents=agents, max_steps=5)


def test_loss_of_a_decoder_is_required(registered, monkeypatch):
    monkeypatch.delattr(Squares, "loss")
    register(Fit.DECODER_LOSS)
    with pytest.raises(LareError, match="'mine' has no method loss"):
        CreditAssigner("mine", observation_space=2, action_space=1)


@pytest.mark.parametrize(
    ("fit", "decoder", "message"),
    [
        (None, "step", "a fit"),
        (Fit.EVIDENCE, "step", "'linear' or 'additive', not 'step'"),
        (Fit.ALL_STEPS, "linear", "with gradients, not 'linear'"),
        (Fit.SIGNS, "additive", "'linear'"),
        (Fit.LIKELIHOOD, "step", "standard deviation"),
        (Fit.DECODER_LOSS, "step", "loss"),
        (Fit.SAMPLED_STEPS, "arel", "the decoder 'arel' all of them"),
    ],
)
def test_register_refuses_a_fit_without_its_decoder(fit, decoder, message, registered):
    with pytest.raises(LareError, match=f"method mine: .*{message}"):
        register_method(Method("mine", "mine", "this test", methods.RAW, fit, decoder))


def test_register_refuses(registered):
    for inputs in (methods.SCORED_AND_HISTORY, input_names.InputNames(("action",), ("action", "history"))):
        with pytest.raises(LareError, match="mine: the input history needs a fit in closed form"):
            register_method(Method("mine", "mine", "this test", inputs, Fit.ALL_STEPS))
    with pytest.raises(LareError, match="another method 'rd'"):
        register_method(Method("rd", "mine", "this test", methods.RAW, Fit.ALL_STEPS))
    with pytest.raises(LareError, match="SIGNS needs factors"):
        register_method(Method("mine", "mine", "this test", methods.RAW, Fit.SIGNS, "linear"))
    with pytest.raises(LareError, match="no decoder 'nothing'"):
        register_method(Method("new", "mine", "this test", decoder="nothing"))
    with pytest.raises(LareError, match="whole_episodes"):
        Decoder("shares", lambda key, spec: None, pays_shares=True)
    with pytest.raises(LareError, match=r"decoder mine: settings = .*'temperature'.*: give a set of names of hidden, "):
        Decoder("mine", "mine:init", settings=frozenset({"hidden", "temperature"}))
    register_method(METHODS["rd"])

"""Names of arrays and keys that earlier versions have saved."""

import pytest

from lare_rl.util.renamed_fields import rename_fields, rename_keys, rename_options


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (".credit[0].closed.summed.episodes", ".decoders[0].closed_form.sufficient_statistics.n_episodes"),
        (".credit[0].decoder.step", ".decoders[0].network.position"),
        (".credit[0].decoder.number", ".decoders[0].network.index_embeddings"),
        (".decoders[0].optimizer[0].mu.agent_numbers", ".decoders[0].optimizer[0].mu.index_embeddings"),
        (".credit[0].decoder.step.layers[0].weight", ".decoders[0].network.step_model.layers[0].weight"),
        (".decoders[0].decoder.network.layers[0].bias", ".decoders[0].network.mlp.layers[0].bias"),
        ("[0].decoder.decoder.network.layers[0].bias", "[0].network.step_decoder.mlp.layers[0].bias"),
        (
            ".decoders[1].optimizer[0].mu.network.layers[0].bias",
            ".decoders[1].optimizer[0].mu.mlp.layers[0].bias",
        ),
        (".decoders[0].optimizer[0].nu.last.bias", ".decoders[0].optimizer[0].nu.head.bias"),
        (".decoders[0].closed_form.decoder.mean", ".decoders[0].closed_form.decoder.mean"),
        (".algorithm.done", ".algorithm.n_due"),
        (".algorithm.states.rows", ".algorithm.mixer_statistics.n_rows"),
        (".replay.segments.episodes", ".replay.segments.current_episode"),
        (".scale[0].episodes", ".decoders[0].scale.n_episodes"),
        ("[1].mean_square", "[0].scale.mean_square"),
        (".reward_sources[0].is_average", ".decoders[0].is_average"),
        (".decoders[0].scale.n_episodes", ".decoders[0].scale.n_episodes"),
        (".decoders[0].closed_form.posterior.n_determined", ".decoders[0].closed_form.posterior.n_effective"),
        (".observations.mean", ".observation_rms.mean"),
        (".algorithm.qmix.online.agent.decoder.weight", ".algorithm.networks.online.agent.head.weight"),
        (
            ".algorithm.qmix.online.agent.memory.given.weight",
            ".algorithm.networks.online.agent.gru.input_projection.weight",
        ),
        ("[0].rivals.episodes", "[0].score_type_predictions.n_episodes"),
        ("steps", "steps"),
    ],
)
def test_rename_fields(old, new):
    assert rename_fields(old) == new
    assert rename_fields(new) == new


def test_rename_keys():
    assert rename_keys({"judges": "both", "name": "x"}) == {"scored_observation": "both", "name": "x"}
    assert rename_keys({"judges": "both", "scored_observation": "after"}) == {
        "judges": "both",
        "scored_observation": "after",
    }
    names_of_others = {"arguments": {"cards": 5}, "functions": {"judges": ["phi.py"]}}
    assert rename_keys(names_of_others) == names_of_others


def test_rename_options():
    arguments = ["verify", "phi.py", "--judges", "both", "--judges=after", "--fit=4", "x=1=2", "--steps"]
    arguments += ["--credit.steps", "8", "--credit.episodes=9"]
    new = [
        "verify",
        "phi.py",
        "--scored-observation",
        "both",
        "--scored-observation=after",
        "--fit=4",
        "x=1=2",
        "--steps",
    ]
    new += ["--credit.batch-steps", "8", "--credit.batch-episodes=9"]
    assert rename_options(arguments) == new

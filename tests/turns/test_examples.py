"""The single files for trainers of language models, on the data types of the libraries, where these are installed."""

import asyncio
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def load(name):
    return SimpleNamespace(**runpy.run_path(str(EXAMPLES / name)))


def make_messages(passes):
    call = {"id": "1", "name": "test", "arguments": "{}"}
    return [
        {"role": "user", "content": "Repair it."},
        {"role": "assistant", "content": "", "tool_calls": [call]},
        {"role": "tool", "tool_call_id": "1", "content": "3 passed" if passes else "3 failed"},
        {"role": "assistant", "content": "Done."},
    ]


class FakeMessage(SimpleNamespace):
    def model_dump(self, exclude_none=False):
        return vars(self)


def fake_trace(passes):
    """Return an object with what the example reads of a trace of verifiers."""
    nodes = []
    for message in make_messages(passes):
        mask = [message["role"] == "assistant" and i > 0 for i in range(3)]
        nodes.append(SimpleNamespace(message=FakeMessage(**message), token_ids=[0, 1, 2], mask=mask, advantages=None))
    return SimpleNamespace(
        nodes=nodes, info={}, reward=float(passes), is_truncated=False, num_branches=1, has_error=False
    )


def assign_advantages(trace, values):
    """Assign one value for each sampled token, as prime-rl does."""
    counts = [sum(node.mask) for node in trace.nodes]
    values = [values] * sum(counts) if isinstance(values, float) else values
    assert len(values) == sum(counts)
    for node, piece in zip(trace.nodes, np.split(np.array(values), np.cumsum(counts)[:-1]), strict=True):
        if any(node.mask):
            node.advantages = piece.tolist()


@pytest.fixture
def fake_prime_rl(monkeypatch):
    class Algorithm:
        def __init__(self, config, policy_pool):
            self.config = config

    base = {
        "Algorithm": Algorithm,
        "iter_trainable_traces": lambda episodes: [(e, trace) for e in episodes for trace in e.traces],
    }
    modules = {
        "prime_rl": {},
        "prime_rl.orchestrator": {},
        "prime_rl.orchestrator.algo": {"ALGORITHM_CLASSES": {"grpo": Algorithm}},
        "prime_rl.orchestrator.algo.base": base,
        "prime_rl.orchestrator.algo.routing": {"assign_advantages": assign_advantages},
    }
    for name, values in modules.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    sys.modules["prime_rl.orchestrator"].algo = sys.modules["prime_rl.orchestrator.algo"]
    return sys.modules["prime_rl.orchestrator.algo"]


def test_prime_rl_algorithm(fake_prime_rl):
    load("turn_credit_prime_rl.py").register()
    algorithm = fake_prime_rl.ALGORITHM_CLASSES["grpo"](None, None)
    for _ in range(6):
        traces = [fake_trace(k % 2 == 0) for k in range(8)]
        traces[7].num_branches = 2
        asyncio.run(algorithm.score_group([SimpleNamespace(traces=traces)]))
    for trace in traces[:7]:
        sampled = [node.advantages for node in trace.nodes if any(node.mask)]
        assert [len(values) for values in sampled] == [2, 2]
        assert [values[0] for values in sampled] == pytest.approx(trace.info["turn_advantages"])
        assert np.sign(sampled[0][0]) == (1 if trace.reward else -1)
    assert [node.advantages for node in traces[7].nodes if any(node.mask)] == [[-0.5, -0.5]] * 2


def test_trl_trainer(monkeypatch):
    torch = pytest.importorskip("torch")
    mask = torch.tensor([1, 1, 0, 0, 1, 0])
    prompts = [[{"role": "user", "content": str(k // 8)}] for k in range(32)]
    completions = [make_messages(k % 2)[1:] for k in range(32)]

    class Trainer:
        """Does what GRPOTrainer does with these two methods, without a model."""

        accelerator, model = SimpleNamespace(process_index=0), SimpleNamespace(training=True)
        reward_weights, scale_rewards = torch.ones(1), "none"

        def _calculate_rewards(self, inputs, prompts, completions, completion_ids_list):
            return torch.tensor([[float(k % 2)] for k in range(len(prompts))])

        def _generate_and_score_completions(self, inputs):
            rewards = self._calculate_rewards(inputs, prompts, completions, None)
            masks = {"completion_mask": torch.ones(len(inputs), 6).long(), "tool_mask": mask.repeat(len(inputs), 1)}
            return {"advantages": rewards[:, 0] - rewards.mean(), **masks}

    monkeypatch.setitem(sys.modules, "trl", SimpleNamespace(GRPOTrainer=Trainer))
    example = load("turn_credit_trl.py")
    assert example.spread_over_tokens([0.5, -1.0], mask).tolist() == [0.5, 0.5, 0, 0, -1.0, 0]
    assert example.spread_over_tokens([0.5], mask) is None
    trainer = example.TurnCreditGRPOTrainer()
    advantages = trainer._generate_and_score_completions([{"prompt": prompt} for prompt in prompts])["advantages"]
    assert advantages.shape == (32, 6)
    assert (advantages[:, [2, 3, 5]] == 0).all()
    assert (advantages[1::2, 0] > 0).all()
    assert (advantages[0::2, 0] < 0).all()

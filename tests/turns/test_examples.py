"""The single files for trainers of language models, on the data types of the libraries, where these are installed."""

import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

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


def test_prime_rl_example_is_valid_python():
    compile((EXAMPLES / "turn_credit_prime_rl.py").read_text(encoding="utf-8"), "turn_credit_prime_rl.py", "exec")


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

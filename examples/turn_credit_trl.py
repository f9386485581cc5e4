"""Credit for turns in TRL: a `GRPOTrainer` whose advantages have two dimensions.

    from turn_credit_trl import TurnCreditGRPOTrainer

    trainer = TurnCreditGRPOTrainer(model=..., reward_funcs=..., environment_factory=..., args=GRPOConfig(...), train_dataset=...)

Copy this file into your project. Read against TRL 1.10.0.dev0 (24 July 2026), and tested with 1.16.0.
The prompts must be conversations, and the completions must have tools: only then does TRL know turns. Numbers of turns from your
environment are an extra field `turns` of the inputs, such as a `rollout_func` returns: a list with a mapping for each turn. With several
processes, values are fitted to the rollouts of each process.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from trl import GRPOTrainer

from lare_rl import TurnCredit

__all__ = ["TurnCreditGRPOTrainer", "spread_over_tokens"]


def spread_over_tokens(advantage: Sequence[float], mask: torch.Tensor) -> torch.Tensor | None:
    """Return the advantage of each token: that of its turn, 0 for tokens that are not the model's.

    Args:
        advantage: of each turn.
        mask: 1 for the model's tokens, 0 for results of tools and for padding, of one completion.

    Returns:
        The advantages, or None if the runs of the model's tokens are not as many as the turns.
    """
    is_first = torch.diff(mask.long(), prepend=mask.new_zeros(1).long()) == 1
    turn = torch.cumsum(is_first, 0)
    if int(turn[-1] if len(turn) else 0) != len(advantage):
        return None
    values = torch.tensor([0.0, *advantage], dtype=torch.float32, device=mask.device)
    return values[turn] * mask


class TurnCreditGRPOTrainer(GRPOTrainer):
    """GRPO with an advantage for each turn. Completions without known turns keep the advantage of GRPO."""

    def __init__(self, *args: Any, turn_credit: TurnCredit | None = None, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.turn_credit = turn_credit or TurnCredit()

    def _calculate_rewards(self, inputs: Any, prompts: Any, completions: Any, completion_ids_list: Any) -> torch.Tensor:
        rewards = super()._calculate_rewards(inputs, prompts, completions, completion_ids_list)
        start = self.accelerator.process_index * len(prompts)
        local = rewards[start : start + len(prompts)]
        outcomes = (local * self.reward_weights.to(local.device)).nansum(dim=1)
        self._scored = list(zip(inputs, prompts, completions, outcomes.tolist(), strict=True))
        return rewards

    def _generate_and_score_completions(self, inputs: list[dict[str, Any]]) -> dict[str, Any]:
        output = super()._generate_and_score_completions(inputs)
        if "tool_mask" not in output or not self.model.training:
            return output
        rollouts = [_make_rollout(*scored) for scored in self._scored]
        mask = output["completion_mask"] * output["tool_mask"]
        unit = 1.0
        if (
            self.scale_rewards != "none"
        ):  # of all rollouts: within a group, a deviation would give hard tasks more weight
            unit = max(torch.tensor([rollout["outcome"] for rollout in rollouts]).std().item(), 1e-4)
        advantages = output["advantages"].unsqueeze(1) * mask.float()
        for k, advantage in enumerate(self.turn_credit(rollouts).advantage):
            tokens = spread_over_tokens(list(advantage / unit), mask[k])
            if tokens is not None:
                advantages[k] = tokens
        return {**output, "advantages": advantages}


def _make_rollout(inputs: Mapping[str, Any], prompt: Any, completion: Any, outcome: float) -> dict[str, Any]:
    rollout = {"messages": completion, "outcome": outcome, "group": str(prompt)}
    turns = inputs.get("turns")
    return rollout if turns is None else {**rollout, "turns": turns}

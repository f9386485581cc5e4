"""Credit for turns in prime-rl, with environments of verifiers: an algorithm in the place of GRPO's.

Copy this file into your project, and start the orchestrator by it instead of by `orchestrator`:

    python turn_credit_prime_rl.py @ orchestrator.toml

Nothing else changes: the configuration says `type = "grpo"`. Read against prime-rl 559b447 and verifiers a60a606 (22 August 2026). Numbers
of turns from your environment are taken from `trace.info["turns"]`: a list with a mapping from names to numbers for each turn. They matter
most (docs/tutorials/agents-that-talk.md).
"""

from collections import deque
from collections.abc import Sequence
from typing import Any

from lare_rl import TurnCredit

N_GROUPS = 32
"""prime-rl scores one group at a time. Values are fitted to the newest groups, this one included."""


def trace_rollout(trace: Any, group: str) -> dict[str, Any]:
    """Return a trace of verifiers as a rollout."""
    messages = [node.message.model_dump(exclude_none=True) for node in trace.nodes]
    rollout = {"messages": messages, "outcome": trace.reward, "group": group, "truncated": bool(trace.is_truncated)}
    turns = trace.info.get("turns")
    return rollout if turns is None else {**rollout, "turns": turns}


def token_advantages(trace: Any, advantage: Sequence[float]) -> list[float]:
    """Return the advantage of each sampled token of a trace, in the order of its nodes: that of the token's turn."""
    turns = [node for node in trace.nodes if node.message.role == "assistant"]
    values = zip(turns, advantage, strict=True)
    return [float(value) for node, value in values for is_sampled in node.mask if is_sampled]


def is_linear(trace: Any) -> bool:
    """Return whether a trace is one conversation, in which only the assistant's messages have sampled tokens."""
    return trace.num_branches == 1 and all(node.message.role == "assistant" for node in trace.nodes if any(node.mask))


def make_algorithm() -> type:
    """Return the algorithm. prime-rl must be installed."""
    from prime_rl.orchestrator.algo.base import Algorithm, iter_trainable_traces
    from prime_rl.orchestrator.algo.routing import assign_advantages

    class TurnCreditAlgorithm(Algorithm):
        """GRPO with an advantage for each turn. Traces with branches get the outcome minus the mean of their group."""

        def __init__(self, config: Any, policy_pool: Any):
            super().__init__(config, policy_pool)
            self.credit = TurnCredit(window=1)
            self.newest_groups: deque[list[dict[str, Any]]] = deque(maxlen=N_GROUPS)
            self.n_groups = 0

        async def score_group(self, episodes: list[Any]) -> None:
            traces = [trace for _, trace in iter_trainable_traces(episodes)]
            if not traces:
                return
            mean = sum(trace.reward for trace in traces) / len(traces)
            linear = [trace for trace in traces if is_linear(trace)]
            self.n_groups += 1
            self.newest_groups.append([trace_rollout(trace, str(self.n_groups)) for trace in linear])
            rollouts = [rollout for group in self.newest_groups for rollout in group]
            advantages = self.credit(rollouts).advantage[len(rollouts) - len(linear) :] if rollouts else []
            for trace in traces:
                assign_advantages(trace, trace.reward - mean)
            for trace, advantage in zip(linear, advantages, strict=True):
                assign_advantages(trace, token_advantages(trace, advantage.tolist()))
                trace.info["turn_advantages"] = [float(value) for value in advantage]

    return TurnCreditAlgorithm


def register() -> None:
    """Put the algorithm in the place of GRPO's. Its configuration is that of GRPO; a length penalty is ignored."""
    from prime_rl.orchestrator import algo

    algo.ALGORITHM_CLASSES["grpo"] = make_algorithm()


if __name__ == "__main__":
    from prime_rl.entrypoints.orchestrator import main

    register()
    main()

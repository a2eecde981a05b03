"""A policy of action vectors as an ONNX graph of one window of history."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from ucfrec.episodes.windows import Windows
from ucfrec.errors import InputError
from ucfrec.files.atomic import atomic_folder, write_json
from ucfrec.recommending.export import (
    DESCRIPTION,
    GRAPH,
    require_close,
    require_installed,
    start_runner,
    write_graph,
)
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_control.training.evaluate import choose_rule, load_run

_MEANINGS: Final = {
    "observations": "of the last K steps, the one to decide included and last; any finite numbers "
    "before the episode began",
    "actions": "of the same steps; the last row, of the step to decide, is not read",
    "rewards": "of the same steps; the last one is not read",
    "steps": "number of steps that the episode has had",
    "target_return": "return that the rest of the episode shall have: the target less the rewards "
    "so far, or where `target_per_step` is true, the target itself",
}
_REMEDY: Final = "use ucfrec_control.ControlPolicy"
_COMPARED: Final = 64
"""Random windows on which the graph is compared with torch."""


class WindowGraph(nn.Module):
    """The next action from the last K steps of an episode."""

    def __init__(self, trained: TrainedPolicy) -> None:
        super().__init__()
        record = trained.record
        self.policy, self.returns = trained.policy, record.return_to_go
        observed = np.arange(trained.logged_observation_size)
        self.register_buffer(
            "seen", torch.from_numpy(np.setdiff1d(observed, record.dropped_observations))
        )

    def forward(
        self,
        observations: Tensor,
        actions: Tensor,
        rewards: Tensor,
        steps: Tensor,
        target_return: Tensor,
    ) -> Tensor:
        """Actions (B, A) after observations (B, K, O), actions (B, K, A), rewards (B, K), `steps`
        (B,) int64 and target returns (B,); see `_MEANINGS`."""
        numbers = steps.unsqueeze(1) + torch.arange(1 - observations.shape[1], 1)
        states = observations.index_select(2, self.get_buffer("seen"))
        windows = Windows.of(numbers, states, actions, rewards)
        returns_to_go = self.returns.before(target_return, windows.rewards)
        returns_to_go = returns_to_go.masked_fill(~windows.mask, 0.0)
        return self.policy.act(replace(windows, returns_to_go=returns_to_go))


def export_run(run: Path, out: Path, checkpoint: str = "last") -> float:
    """Write `model.onnx` and `model.json`, which says what its inputs are, to a new folder.
    InputError if `run` is not a finished run of `ucfrec-control train`, is of IQL or CQL, the extra
    `export` is missing, the graph differs from torch, or `out` exists.

    Returns:
        The largest difference to torch, relative to the largest action; at most 1e-5.
    """
    trained = load_run(run, checkpoint)
    if not isinstance(trained, TrainedPolicy):
        raise InputError(f"{run} is of IQL or CQL; export it with d3rlpy, or {_REMEDY}")
    rule = choose_rule(trained)
    require_installed()
    graph = WindowGraph(trained).eval()
    arguments, batch = _draw_windows(graph, trained, 3), torch.export.Dim("batch", min=1, max=2**20)
    shapes = {name: {0: batch} for name in arguments}
    with atomic_folder(out) as scratch:
        write_graph(graph, arguments, scratch / GRAPH, ["action"], trained.name, _REMEDY, shapes)
        runner, difference = start_runner(scratch / GRAPH), 0.0
        input_names = {entry.name for entry in runner.get_inputs()}
        for count in (_COMPARED, 1):
            arguments = _draw_windows(graph, trained, count)
            with torch.no_grad():
                expected = graph(**arguments)
            fed = {name: value.numpy() for name, value in arguments.items() if name in input_names}
            size = max(float(expected.abs().max()), 1e-30)
            pairs = zip(runner.run(None, fed), [expected], strict=True)
            difference = max(difference, require_close(pairs, _REMEDY, size))
        description: dict[str, Any] = {
            "inputs": {
                name: {"shape": ["batch", *value.shape[1:]], "meaning": _MEANINGS[name]}
                for name, value in arguments.items()
                if name in input_names
            },
            "outputs": {"action": {"shape": ["batch", *expected.shape[1:]]}},
            "context": trained.policy.config.context,
            "target_return": None if rule is None else rule.target,
            "target_per_step": not trained.record.return_to_go.per_session,
            "policy": trained.name,
            "fingerprint": trained.fingerprint,
        }
        write_json(scratch / DESCRIPTION, description)
    return difference


def _draw_windows(graph: WindowGraph, trained: TrainedPolicy, count: int) -> dict[str, Tensor]:
    """Random inputs of a graph, in the order of its arguments."""
    rng, policy, k = np.random.default_rng(count), graph.policy, graph.policy.config.context
    observations = torch.zeros(count, k, trained.logged_observation_size)
    noise = torch.from_numpy(rng.normal(size=(count, k, len(policy.state_mean)))).float()
    observations[..., graph.get_buffer("seen")] = noise * policy.state_std + policy.state_mean
    actions = rng.uniform(-1, 1, (count, k, trained.record.sizes["action"]))
    return {
        "observations": observations,
        "actions": torch.from_numpy(actions).float(),
        "rewards": torch.from_numpy(rng.normal(size=(count, k))).float(),
        "steps": torch.from_numpy(rng.integers(0, 2 * k + 1, count)),
        "target_return": torch.from_numpy(rng.choice(trained.training_returns, count)),
    }

"""gSASRec: the loss is the paper's, and its best scores are the items' probabilities."""

import math
from pathlib import Path

import pytest
import torch

from tests.support.tagged import tagged_store
from ucfrec.runs.config import resolve_config
from ucfrec.runs.start import new_policy


@pytest.mark.parametrize("negatives", [4, 10_000])
def test_the_loss_is_that_of_the_paper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, negatives: int
) -> None:
    store = tagged_store(tmp_path).split("train")
    settings = {"policy.dim": 16, "policy.context": 6, "policy.negatives": negatives}
    policy = new_policy(store, resolve_config("gsasrec", None, settings)).eval()
    n_items = len(store.item_states.embeddings)
    drawn = torch.arange(min(negatives, n_items))
    monkeypatch.setattr(torch, "unique", lambda _: drawn)
    windows = store.windows(*store.locate(torch.arange(20).numpy()), 6)
    found = policy.loss(windows)[0].detach()
    normalized = policy.normalize(windows)
    with torch.no_grad():
        scores = policy.head.predict(policy.features(normalized)[windows.mask])
    rate = (len(drawn) - 1) / (n_items - 1)
    beta = rate * (0.75 * (1 - 1 / rate) + 1 / rate)
    expected = []
    for row, item in zip(scores.double(), windows.actions[windows.mask].tolist(), strict=True):
        row = torch.sigmoid(row + math.log(beta / rate))
        others = [int(other) for other in drawn if other != item]
        total = beta * math.log(row[item]) + sum(math.log(1 - row[other]) for other in others)
        expected.append(-total / (len(drawn) + 1))
    assert float(found) == pytest.approx(sum(expected) / len(expected), rel=1e-4)

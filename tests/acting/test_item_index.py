"""The approximate search scores exactly what it finds, and reports how much that is."""

from pathlib import Path

import pandas as pd
import pytest
import torch
from torch import Tensor

from tests.support.served import FULL, histories, learn_tastes, trained_run
from ucfrec.acting import item_index
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.item_index import ItemIndex
from ucfrec.commands.cli import main
from ucfrec.episodes.windows import Sessions
from ucfrec.errors import InputError
from ucfrec.runs.trained_policy import TrainedPolicy

pytest.importorskip("faiss")

RULES = [DecisionRule(2.0), FULL, DecisionRule(1.0, reward_weight=3.0, tag_run=1)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    trained = trained_run(tmp_path_factory.mktemp("index"))
    with torch.no_grad():  # a policy of 20 steps has hardly any opinion
        for parameter in trained.policy.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape))
    learn_tastes(trained)
    return trained


def sessions(trained: TrainedPolicy, rule: DecisionRule, count: int = 40) -> Sessions:
    generator, length = torch.Generator().manual_seed(1), trained.scorer(rule).length
    items = torch.randint(24, (count, length), generator=generator)
    rewards = torch.randint(2, (count, length), generator=generator).float()
    steps, users = torch.full((count,), length), torch.arange(count) % 30 - 1
    return Sessions(items, rewards, steps, rewards.sum(1, dtype=torch.float64), users)


def some_left_out(sessions: Sessions) -> tuple[Tensor, Tensor]:
    rows = torch.arange(len(sessions.users)).repeat_interleave(3)
    return rows, sessions.actions[:, -3:].flatten()


@pytest.mark.parametrize("rule", RULES, ids=["plain", "full", "run"])
def test_a_search_of_all_lists_is_exact(trained: TrainedPolicy, rule: DecisionRule) -> None:
    asked, scorer = sessions(trained, rule), trained.scorer(rule)
    left_out, index = some_left_out(asked), ItemIndex(scorer, "ucf")
    excluded = torch.arange(24) == 7
    items, values = index.best(asked, left_out, excluded, 6)
    exact = scorer.scores(asked, left_out, excluded, empty=True)
    expected = exact.topk(6)
    torch.testing.assert_close(exact.gather(1, items), expected.values, rtol=1e-5, atol=1e-5)
    relative = expected.values - expected.values[:, :1]
    torch.testing.assert_close(values, relative, rtol=1e-4, atol=1e-4)
    assert index.found == index.wanted > 0


def test_what_is_found_has_its_score_and_the_recall_is_told(
    trained: TrainedPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"_FEWEST": 1, "_AT_LEAST": 1, "_SAMPLE": 1}.items():
        monkeypatch.setattr(item_index, name, value)
    rule = DecisionRule(1.0, reward_weight=3.0)
    asked, scorer = sessions(trained, rule), trained.scorer(rule)
    nothing = (torch.empty(0, dtype=torch.int64),) * 2
    index = ItemIndex(scorer, "ucf")
    items, values = index.best(asked, nothing, None, 2)
    exact = scorer.scores(asked)
    theirs = exact.gather(1, items)
    torch.testing.assert_close(values, theirs - theirs[:, :1], rtol=1e-4, atol=1e-4)
    best = exact.topk(2).indices
    found = sum(len(set(a) & set(b)) for a, b in zip(items.tolist(), best.tolist(), strict=True))
    assert index.sampled == 40
    assert index.wanted == 80
    assert index.found == found < 80


def test_the_command_tells_the_recall(
    trained: TrainedPolicy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    histories(users=5).to_parquet(tmp_path / "log.parquet")
    out = tmp_path / "out.parquet"
    asked = [str(trained.folder), str(tmp_path / "log.parquet"), "--out", str(out), "--k", "4"]
    assert main(["recommend", *asked, "--approximate", "--temperature", "0"]) == 0
    assert "recall@4 against the exact search: 1.000 (1 users)" in capsys.readouterr().out
    assert len(pd.read_parquet(out)) == 20
    assert main(["recommend", *asked[:-4], "--stream", "--approximate"]) == 2
    assert "--stream" in capsys.readouterr().err


def test_what_needs_all_scores_is_refused(trained: TrainedPolicy, tmp_path: Path) -> None:
    drawn = DecisionRule(1.0, temperature=0.5)
    with pytest.raises(InputError, match=r"leave --approximate out, or give --temperature 0"):
        ItemIndex(trained.scorer(drawn), "ucf")
    other = trained_run(tmp_path, "item-knn")
    with pytest.raises(InputError, match="leave --approximate out"):
        ItemIndex(other.scorer(), other.name)

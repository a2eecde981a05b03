"""What is said of a policy that predicts choices no better than popularity does."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from ucfrec import Recommender
from ucfrec.commands.cli import main
from ucfrec.errors import InputNote
from ucfrec.runs.record import RunRecord

LOGGED = {"action_loss", "validation_loss"}
SETTINGS = ["train.steps=150", "train.validate_every=150", "policy.dim=16", "policy.context=4"]
SETTINGS += ["train.learning_rate=0.01", "augment.copies=0", "rule.choose=false"]
SAID = "the policy learned nothing about users; train with more steps"


def record(best: float | None, popularity: float | None) -> RunRecord:
    losses = None if popularity is None else {"popularity": popularity}
    trained = None if best is None else SimpleNamespace(best_validation=best)
    return RunRecord.model_construct(policy=trained, reference_losses=losses)


@pytest.mark.parametrize(
    ("best", "popularity", "logged", "said"),
    [
        (3.0, 3.0, LOGGED, True),
        (3.1, 3.0, LOGGED, True),
        (2.9, 3.0, LOGGED, False),
        (float("nan"), 3.0, LOGGED, False),
        (None, 3.0, LOGGED, False),
        (3.1, None, LOGGED, False),
        (3.1, 3.0, {"validation_loss"}, False),
    ],
)
def test_only_a_comparable_loss_that_is_not_lower_is_told(
    best: float | None, popularity: float | None, logged: set[str], said: bool
) -> None:
    assert (SAID in record(best, popularity).learned_nothing(logged)) == said


def log(users_differ: bool) -> pd.DataFrame:
    """Users see items of their own half of the catalogue, or any."""
    rng, n = np.random.default_rng(0), 3000
    frame = pd.DataFrame({"user_id": rng.integers(60, size=n), "item_id": rng.integers(20, size=n)})
    if users_differ:
        frame["item_id"] = 2 * (frame.item_id // 2) + frame.user_id % 2
    frame["timestamp"] = 1_700_000_000_000 + 20_000 * np.arange(n)
    return frame.assign(reward=(rng.random(n) < 0.3) * 1.0)


@pytest.mark.parametrize(
    ("users_differ", "policy", "said"),
    [(False, "dt", True), (True, "dt", False), (False, "popular", False)],
)
def test_train_and_fit_say_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], users_differ: bool, policy: str, said: bool
) -> None:
    log(users_differ).to_parquet(tmp_path / "log.parquet")
    store, run = str(tmp_path / "store"), str(tmp_path / "run")
    prepare = ["prepare", str(tmp_path / "log.parquet"), "--out", store, "--session-by", "user"]
    assert main(prepare) == 0
    sets = [word for setting in SETTINGS for word in ("--set", setting)]
    if policy == "popular":
        sets = ["--set", "rule.choose=false"]
    capsys.readouterr()
    assert main(["train", store, "--out", run, "--policy", policy, *sets]) == 0
    assert (SAID in capsys.readouterr().out) == said
    assert (SAID in (tmp_path / "run" / "MODEL_CARD.md").read_text()) == said
    if said:
        with pytest.warns(InputNote, match=SAID):
            Recommender(policy, settings=SETTINGS).fit(log(users_differ), session_by="user")

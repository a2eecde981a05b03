"""The model card says what the record says, and keeps the newest of each measurement."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from ucfrec.errors import InputError
from ucfrec.reporting.model_card import CARD, MEASURED, add_measurement, write_card
from ucfrec.runs.config import resolve_config

RECORD: dict[str, Any] = {
    "files": {}, "command": "ucfrec train", "store": "store", "store_from_run": None,
    "session_gap_ms": 1_800_000, "wall_time_s": 9.0,
    "seed": 4, "reward": "is_click", "session_by": "gap", "fingerprint": "f" * 64,
    "train_episodes": 1200, "train_steps": 5400, "mean_return": 0.75,
    "return_quantiles": {"0.5": 1.0, "1.0": 9.0},
    "sizes": {"items": 80, "state": 9, "action": 8, "users": 33, "tags": 0},
    "observation_size": 0,
    "return_to_go": {"definition": "session", "horizon": 1},
    "versions": {"ucfrec": "0.1.0"}, "reference_losses": {"uniform": 4.4, "popularity": 3.6},
    "policy": {"steps": 300, "best_step": 200, "best_validation": 3.5, "seconds": 8.0},
    "data": {
        "files": ["/home/me/secret/log.parquet"], "users": 33,
        "time_range_ms": [1_574_553_600_000, 1_575_158_400_000], "unknown_propensities": 7,
        "split_times_ms": [1_575_072_000_000, 1_575_115_200_000],
        "feature_tables": {"item_id": {"items.csv": {"numbers": 2, "tags": 1}, "b.csv": {}}},
    },
}  # fmt: skip


def run(folder: Path, **changes: Any) -> Path:
    folder.mkdir()
    config = dataclasses.asdict(resolve_config("dt"))
    (folder / "run.json").write_text(json.dumps(RECORD | {"config": config} | changes))
    (folder / "decision_rule.json").write_text(json.dumps({"target": 9.0}))
    return folder


def text_of(folder: Path) -> str:
    return (folder / CARD).read_text(encoding="utf-8")


def test_it_says_data_reward_rule_and_limits(tmp_path: Path) -> None:
    folder = run(tmp_path / "run")
    assert write_card(folder) == folder / CARD
    card = text_of(folder)
    for what in (
        "# Model card: dt", "2019-11-24 00:00 to 2019-11-30 00:00", "| reward | `is_click` |",
        "| item_id features in items.csv | 2 numbers, 1 tags |", "in b.csv | no columns |",
        "| training steps | 5,400 |", "Its decision rule: target 9, argmax.",
        "It knows 80 items and never shows another one.", "7 steps of its logs have no propensity",
        "Nothing yet: `ucfrec evaluate`",
    ):  # fmt: skip
        assert what in card, what
    assert "log.parquet" in card
    assert not any(what in card for what in ("secret", "learned nothing"))


def test_limits_follow_the_record(tmp_path: Path) -> None:
    worse = RECORD["policy"] | {"best_validation": 3.7}
    folder = run(tmp_path / "run", policy=worse, data={"files": []})
    (folder / "policy").mkdir()
    (folder / "policy" / "metrics.jsonl").write_text('{"step": 1, "action_loss": 4.0}\n')
    write_card(folder)
    card = text_of(folder)
    assert "3.7, is not below 3.6, the loss of showing items by popularity: the policy" in card
    assert "Its logs have no propensities" in card
    (folder / "decision_rule.json").unlink()
    write_card(folder)
    assert "Its decision rule is not chosen yet." in text_of(folder)
    with pytest.raises(InputError, match="not a run folder"):
        write_card(tmp_path)


def test_a_refit_knows_all_rows_of_its_store(tmp_path: Path) -> None:
    refitted = RECORD["policy"] | {"best_validation": float("nan")}
    write_card(run(tmp_path / "run", policy=refitted, refit_of={}))
    card = text_of(tmp_path / "run")
    assert "2019-11-24 00:00 to 2019-12-01 00:00" in card
    assert "not trained on anything after 2019-12-01 00:00 UTC" in card
    assert "It was trained on all rows of its store: only later logs can evaluate it." in card
    assert "is not below" not in card


def test_the_newest_of_each_measurement_is_kept(tmp_path: Path) -> None:
    folder = run(tmp_path / "run")
    add_measurement(folder, "ucfrec ope", "DR on a", {"R_cum": 1.0, "lift": None}, ["Do not."])
    values = {"R_cum": "2 [1, 3]", "episodes": 1000}
    add_measurement(folder, "ucfrec evaluate", "environment", values)
    add_measurement(folder, "ucfrec ope", "DR on a", {"R_cum": 4.0}, ["It earns more."])
    card = text_of(folder)
    assert card.count("### ucfrec ope: DR on a") == 1
    for what in ("| R_cum | 4 |", "| R_cum | 2 [1, 3] |", "- It earns more."):
        assert what in card
    assert not any(what in card for what in ("Do not.", "lift"))
    assert len(json.loads((folder / MEASURED).read_text())) == 2
    write_card(folder)  # training on keeps what was measured
    assert text_of(folder) == card
    for damaged in ("[3]", "7", '[{"how": "x", "of": "y", "values": [1], "said": []}]'):
        (folder / MEASURED).write_text(damaged)
        with pytest.raises(InputError, match=r"measured\.json is damaged"):
            write_card(folder)

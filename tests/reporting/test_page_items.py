"""Reports of policies of items: reference losses, switched-off losses, samples, data, estimates."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.support import episodes, killed_run
from tests.support.episodes import N_ITEMS
from tests.support.report_page import (
    HOSTILE,
    SOURCE,
    estimate,
    number,
    page_of,
    record_of,
    rewritten,
)
from ucfrec.acting.scorer import logged_scores
from ucfrec.commands.cli import main
from ucfrec.episodes.store import ITEM_STATES, EpisodeStore
from ucfrec.errors import InputError
from ucfrec.reporting.page import write_report
from ucfrec.results.rows import write_results
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.trained_policy import TrainedPolicy

SETTINGS = (*killed_run.SETTINGS, "train.steps=20", "train.learning_rate=1e-3")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of items and runs `ucf` and `greedy` on it; treat as read-only."""
    folder = tmp_path_factory.mktemp("items")
    sessions = episodes.random_episodes([2 + n % 6 for n in range(150)], seed=1)
    columns, own = episodes.step_columns(sessions), episodes.episode_columns(sessions)
    lengths = episodes.lengths_of(sessions)
    EpisodeStore.write(folder / "store", columns, lengths, own, source=SOURCE)
    episodes.some_states().save(folder / "store" / ITEM_STATES)
    ids = pa.table({"item_id": [f"item {n}" for n in range(N_ITEMS)], "train_count": [7] * N_ITEMS})
    pq.write_table(ids, folder / "store" / "items.parquet")
    for run, policy_name in (("ucf", "ucf"), ("greedy", "crm-greedy")):
        settings = (*SETTINGS, "augment.copies=1") if run == "ucf" else SETTINGS[:-1]
        config = resolve_config(policy_name, None, settings, seed=3)
        train_run(EpisodeStore.open(folder / "store"), folder / run, config)
    return folder


def test_losses_stand_beside_those_of_simple_policies(folder: Path, tmp_path: Path) -> None:
    store = EpisodeStore.open(folder / "store")
    train, held_out = store.split("train"), store.split("validation")
    shown = np.bincount(train.step_values("item", *train.all_steps()), minlength=N_ITEMS)
    share = (shown + 1) / (shown.sum() + N_ITEMS)
    items = held_out.step_values("item", *held_out.all_steps())
    found = record_of(folder / "ucf")["reference_losses"]
    assert found["uniform"] == pytest.approx(math.log(N_ITEMS))
    assert found["popularity"] == pytest.approx(-np.log(share[items]).mean())
    page = page_of(tmp_path / "report.html", folder / "ucf")
    for name, value in found.items():
        loss = number(page.tables["Runs"][f"loss by {name}"]["ucf"])
        assert loss == pytest.approx(value, rel=1e-3)
    squared = page_of(tmp_path / "greedy.html", folder / "greedy")  # its loss is no likelihood
    assert not [name for name in squared.tables["Runs"] if name.startswith("loss by")]


def test_no_curve_of_a_loss_that_is_switched_off(folder: Path, tmp_path: Path) -> None:
    assert record_of(folder / "ucf")["config"]["policy"]["lambda_mask"] == 0
    tables = page_of(tmp_path / "off.html", folder / "ucf").tables
    assert "Mask loss of the attention (Eq. 5)" not in tables
    assert "Training loss, all terms" not in tables  # it is the action loss
    assert "Training loss of the action (one batch)" in tables
    settings = [*SETTINGS, "policy.lambda_mask=0.1"]
    on = tmp_path / "on"
    train_run(EpisodeStore.open(folder / "store"), on, resolve_config("ucf", None, settings))
    assert "Mask loss of the attention (Eq. 5)" in page_of(tmp_path / "on.html", on).tables


def test_samples_are_what_the_policy_shows(folder: Path, tmp_path: Path) -> None:
    run = folder / "ucf"
    samples = json.loads((run / "samples.json").read_text())
    trained, store = TrainedPolicy.load(run), EpisodeStore.open(folder / "store")
    held_out = store.split("validation")
    assert samples["rule"] == str(trained.rule)
    scores = logged_scores(trained.scorer(), held_out, np.array([0]), held_out.lengths[:1] - 1)
    best = scores[0].topk(5).indices
    session = samples["sessions"][0]
    assert session["recommended"] == best.tolist()
    items = held_out.step_values("item", *held_out.all_steps())[: held_out.lengths[0]]
    assert session["history"] == items[:-1][-5:].tolist()
    assert session["logged"] == items[-1]
    table = page_of(tmp_path / "report.html", run).tables["Held-out session 1"]
    line = next(name for name in table if name.startswith("recommended 1"))
    assert table[line]["item_id"] == f"item {best[0]}"


def test_features_come_beside_samples_and_never_run(folder: Path, tmp_path: Path) -> None:
    features = tmp_path / "features.csv"
    rows = [f'item {n},"{HOSTILE}",{n % 2 * 2026}' for n in range(N_ITEMS)]
    rows = [row.replace('"alert(2)"', "2") for row in rows]
    features.write_text("\n".join(["item_id,title,fresh", *rows]))
    out = tmp_path / "report.html"
    assert main(["report", str(folder / "ucf"), "--items", str(features), "--out", str(out)]) == 0
    page = out.read_text()
    assert all(text in page for text in ("&lt;script&gt;", "fresh 2026"))
    assert not any(text in page for text in ("<script", "fresh 0"))
    features.write_text("id\n1\n")
    unread = folder / "ucf" / "run.json"
    for items, says in ((features, "no column 'item_id'"), (unread, "be read as Parquet or CSV")):
        with pytest.raises(InputError, match=says):
            write_report(out, [folder / "ucf"], items=items)


def test_data_quality_comes_from_the_run_folder(folder: Path, tmp_path: Path) -> None:
    page = page_of(tmp_path / "report.html", folder / "ucf")
    said = dict(re.split(r"  +", line.strip(), maxsplit=1) for line in page.text.splitlines()
                if "  " in line.strip())  # fmt: skip
    assert said["rows read"] == "1,200 from 1 file(s)"
    assert said["dropped: duplicate"].startswith("12 ")
    assert "not recorded" not in page.text


def test_a_run_is_shown_with_what_it_recorded(folder: Path, tmp_path: Path) -> None:
    old = rewritten(folder / "ucf", tmp_path / "old", data={}, reference_losses=None)
    (old / "samples.json").unlink()
    (old / "policy" / "metrics.jsonl").unlink()
    text = page_of(tmp_path / "report.html", old).text
    for what in ("Rows read and dropped", "Curves of old", "old"):
        assert f"{what}: not recorded." in text, what


def test_estimates_from_logs_have_tables_with_their_warnings(folder: Path, tmp_path: Path) -> None:
    same: dict[str, Any] = {
        "metrics": {"effective_sessions": 33.25, "largest_weight": 0.5, "overlap": 1.01},
        "details": {"warnings": [HOSTILE], "verdict": f"Do not rely on it: {HOSTILE}"},
    }
    of = {"sessions": 600, "run": "runs/ucf"}
    step: dict[str, Any] = {"table": "per step", "metric": "R_step", "conditions": of}
    step["metrics"] = {"effective_steps": 9.5, "largest_weight": 0.5}
    rows = [
        estimate("logged", 2.0, "behavior", conditions={**of, "choice": "as logged"}, **same),
        estimate("DR", 3.0, conditions={**of, "choice": "softmax"}, **same),
        estimate("DM", 3.0, interval=None, conditions={**of, "choice": "softmax"}, **same),
        estimate("logged", 0.25, "behavior", interval=(0.125, 0.5), **step),
        estimate("DR", 0.5, interval=None, **step),
    ]
    fewer = [replace(row, conditions={**row.conditions, "sessions": 500}) for row in rows]
    write_results(tmp_path / "ope.json", [*rows, *fewer])
    page = page_of(tmp_path / "report.html", folder / "ucf", results=(tmp_path / "ope.json",))
    assert "Estimates for ucf, sessions 500" in page.tables
    table = page.tables["Estimates for ucf, sessions 600"]
    assert list(table) == ["logged", "DR", "DM"]
    assert table["DR"] == {
        "R_cum": "3 [2.5, 4.5]", "effective_sessions": "33.25", "largest_weight": "0.5",
        "sessions": "600", "overlap": "1.01",
    }  # fmt: skip
    assert table["logged"]["R_cum"] == "2 [1.5, 3.5]"
    assert table["DM"]["R_cum"] == "3 [–]"
    table = page.tables["Estimates per step for ucf, sessions 600"]
    assert table["logged"]["R_step"] == "0.25 [0.125, 0.5]"
    assert table["DR"] == {"R_step": "0.5 [–]", "effective_steps": "9.5", "largest_weight": "0.5"}
    assert page.text.index("Do not rely on it") < page.text.index("Trained on")
    assert HOSTILE in page.text
    assert not {tag for tag, _ in page.elements} & {"script", "img"}

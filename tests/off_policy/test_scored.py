"""Estimates from scored rows are those from the logs that were scored."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.off_policy.conftest import Read
from ucfrec.acting.decision import DecisionRule
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.off_policy import scored
from ucfrec.off_policy.evaluate import EstimateOptions, evaluate_off_policy
from ucfrec.off_policy.score import about_scores, score
from ucfrec.off_policy.scored import evaluate_scored
from ucfrec.runs.trained_policy import TrainedPolicy

RULE = DecisionRule(7.5, temperature=1.0)
WEIGHED = ("logged", "IPS", "SNIPS", "PDIS", "SNPDIS", "clipped IPS")


def scored_parts(
    log: pd.DataFrame, trained: TrainedPolicy, read: Read, out: Path, lacking: int
) -> Path:
    """The logs, now with other propensities or none, scored into three files of any sessions."""
    log["propensity"] = np.random.default_rng(0).uniform(0.02, 0.06, len(log))
    log.loc[log.index[:lacking], "propensity"] = np.nan
    with read(log) as logged:
        frame = pd.concat(score(trained, logged, RULE), ignore_index=True)
    (out / "scored").mkdir()
    for part, (begin, end) in enumerate(((0, 70), (70, 71), (71, len(frame)))):
        table = pa.Table.from_pandas(frame[begin:end], preserve_index=False)
        table = table.replace_schema_metadata(about_scores(trained, RULE))
        pq.write_table(table, out / "scored" / f"part-{part}.parquet")
    return out / "scored"


@pytest.mark.parametrize(("lacking", "discount", "rows"), [(0, 1.0, 7), (25, 0.8, 64)])
def test_estimates_are_those_from_the_logs(
    log: pd.DataFrame,
    trained: TrainedPolicy,
    read: Read,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    lacking: int,
    discount: float,
    rows: int,
) -> None:
    parts = scored_parts(log, trained, read, tmp_path, lacking)
    monkeypatch.setattr(scored, "_BATCH_ROWS", rows)
    options = EstimateOptions(discount=discount)
    found = evaluate_scored(trained, [parts], rule=RULE, seed=3, options=options)
    with read(log, keep=True) as logged:
        expected = evaluate_off_policy(trained, logged, rule=RULE, seed=3, options=options)
    ours, theirs = ({row.method: row for row in each.rows} for each in (found, expected))
    assert {*WEIGHED} <= {*ours}
    assert found.verdict.estimator == "SNPDIS"
    for name in WEIGHED:
        assert ours[name].value == pytest.approx(theirs[name].value, rel=1e-5)
        assert ours[name].conditions == theirs[name].conditions
        if theirs[name].interval is not None:
            assert ours[name].interval == pytest.approx(theirs[name].interval, rel=1e-4, abs=1e-6)
        for column in ("effective_users", "mean_weight", "users", "seen_in_training"):
            mine, full = (each[name].as_line()[column] for each in (ours, theirs))
            assert mine == pytest.approx(full, rel=1e-5)
    # What is found step by step cannot be found of sums of sessions.
    line = ours["SNPDIS"].as_line()
    assert "bounds" not in line
    assert not any("step 1:" in text for text in found.warnings)


def rewrite(file: Path, column: str, values: Any) -> None:
    """Replace the values of a column in some rows of a file."""
    table = pq.read_table(file)
    changed = table[column].to_numpy().astype(np.float64)
    changed[9:11] = values
    table = table.set_column(table.schema.get_field_index(column), column, pa.array(changed))
    pq.write_table(table, file)


@pytest.mark.parametrize(
    ("column", "values", "says"),
    [
        ("session", -1, "part-2.* not numbered in order"),
        ("reward", math.inf, r"part-2\.parquet: reward is not finite at 2 of "),
        ("propensity", 0.0, r"part-2\.parquet: propensities must be above 0 .*; 2 of "),
        ("probability", 1e300, "lie between 0 and 1; 2 of .*, the first is 1e\\+300"),
        ("session", None, "part-2.* has no column session"),
        ("content", None, "part-2.* is damaged"),
        ("twice", None, "not numbered in order"),
        ("rule", None, r"part-0\.parquet was scored with rule '.*', not '"),
        ("pages", True, "need the logs"),
    ],
)
def test_scored_rows_that_cannot_be_used_are_refused(
    log: pd.DataFrame,
    trained: TrainedPolicy,
    read: Read,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    column: str,
    values: Any,
    says: str,
) -> None:
    monkeypatch.setattr(scored, "_BATCH_ROWS", 7)
    parts = scored_parts(log, trained, read, tmp_path, 0)
    file, rule, options = parts / "part-2.parquet", RULE, EstimateOptions()
    if column == "pages":
        options = EstimateOptions(pages=values)
    elif column == "rule":
        rule = DecisionRule(7.5)
    elif column == "twice":
        shutil.copy(parts / "part-0.parquet", parts / "part-7.parquet")
    elif column == "content":
        content = bytearray(file.read_bytes())
        content[100:400] = bytes(300)
        file.write_bytes(content)
    elif values is None:
        pq.write_table(pq.read_table(file).drop_columns([column]), file)
    else:
        rewrite(file, column, values)
    with pytest.raises(InputError, match=says):
        evaluate_scored(trained, [parts], rule=rule, seed=0, options=options)


@pytest.mark.parametrize(("share", "forbids"), [(0.0, False), (0.02, False), (0.2, True)])
def test_the_command_reads_what_score_writes_and_names_unknown_items(
    folder: Path,
    log: pd.DataFrame,
    tmp_path: Path,
    share: float,
    forbids: bool,
    capsys: pytest.CaptureFixture[str],
) -> None:
    unknown = int(share * len(log))
    log.loc[log.index[:unknown], "item_id"] = 10**6
    log.to_parquet(tmp_path / "log.parquet")
    run, out, rule = str(folder / "run"), str(tmp_path / "scored.parquet"), ["--temperature", "1"]
    results = tmp_path / "ope.json"
    assert main(["score", run, str(tmp_path / "log.parquet"), "--out", out, *rule]) == 0
    assert main(["ope", run, out, "--scored", *rule, "--json", str(results)]) == 0
    said = capsys.readouterr().out
    assert "\nthe log cannot say: " in said
    line = json.loads(results.read_text())[-1]["details"]
    text = f"{unknown:,} of {len(log):,} rows show items that the run does not know"
    assert any(text in each for each in line["warnings"]) == (unknown > 0)
    assert (text in line["verdict"]) == forbids
    if not unknown:
        assert main(["ope", run, out, "--scored", *rule, "--temperatures", "1,2"]) == 2
        assert main(["ope", run, "--scored"]) == 2
        page = str(tmp_path / "r.html")
        assert main(["report", run, "--results", str(results), "--out", page]) == 0


@pytest.mark.parametrize("session_by", [pytest.param("gap", marks=pytest.mark.slow), "session_id"])
def test_rows_are_those_of_one_process(
    folder: Path, log: pd.DataFrame, spark: Any, session_by: str, tmp_path: Path
) -> None:
    """With new users and items, sessions that go on from the store, and rows that cannot be used"""
    run = folder / "run"
    if session_by == "session_id":
        run, options = tmp_path / "run", ["--session-by", "session_id", "--reward", "reward"]
        train = pd.read_parquet(folder / "train.parquet")
        train, log = (each.assign(session_id=each.timestamp // 10**7) for each in (train, log))
        train.to_parquet(tmp_path / "train.parquet")
        store = str(tmp_path / "store")
        assert main(["prepare", str(tmp_path / "train.parquet"), *options, "--out", store]) == 0
        small = ["train.steps=3", "policy.dim=8", "policy.context=4", "augment.copies=0"]
        settings = [part for each in small for part in ("--set", each)]
        assert main(["train", store, "--out", str(run), *settings]) == 0
    log["timestamp"] += 10**6
    log.loc[log.index[:9], "item_id"] = 999
    log.loc[log.index[9:12], "timestamp"] = 7
    log.loc[log.user_id == 8, "item_id"] = 999
    log.to_parquet(tmp_path / "log.parquet")
    command = ["score", str(run), str(tmp_path / "log.parquet"), "--temperature", "0.7"]
    found = {}
    for engine in ("torch", "spark"):
        out = str(tmp_path / engine)
        assert main([*command, "--engine", engine, "--out", out]) == 0
        found[engine] = pd.read_parquet(out)
    assert len(list((tmp_path / "spark").iterdir())) == 2
    pd.testing.assert_frame_equal(found["spark"], found["torch"], rtol=1e-4, atol=1e-6)
    assert found["spark"].session.nunique() == found["spark"].session.max() + 1 > 100

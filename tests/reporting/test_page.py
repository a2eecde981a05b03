"""The report: its numbers are the runs', it stands alone, and nothing from outside runs in it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.support import killed_run
from tests.support.report_page import HOSTILE, number, page_of, record_of, rewritten, row
from ucfrec.commands.cli import main
from ucfrec.episodes.store import EpisodeStore
from ucfrec.fitting.checkpoint import METRICS, MetricsLog, read_metrics
from ucfrec.results.rows import append_rows, write_results
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs `ucf` and `dt` on one store and `other` on another; treat as read-only."""
    folder = tmp_path_factory.mktemp("report")
    for name, n in (("store", 120), ("other-store", 60)):
        rng = np.random.default_rng(n)
        lengths = rng.integers(3, 9, size=n)
        observation = rng.normal(size=(lengths.sum(), 4))
        action = rng.uniform(-1, 1, size=(lengths.sum(), 2))
        reward = observation[:, 0] * action[:, 0] + 0.5 * rng.normal(size=lengths.sum())
        columns = {"observation": observation, "action": action, "reward": reward}
        split = np.repeat([0, 1], [n * 3 // 4, n - n * 3 // 4]).astype(np.uint8)
        EpisodeStore.write(folder / name, columns, lengths, {"split": split})
    small = [*killed_run.SETTINGS, "train.steps=30"]
    supervised = {"ucf": ["policy.lambda_mask=0.1", "augment.copies=1"]}
    for run, store, policy_name in (("ucf", "store", "ucf"), ("dt", "store", "dt"),
                                ("other", "other-store", "dt")):  # fmt: skip
        config = resolve_config(policy_name, None, [*small, *supervised.get(run, [])], seed=3)
        train_run(EpisodeStore.open(folder / store), folder / run, config)
    return folder


def test_the_numbers_are_those_of_the_record(runs: Path, tmp_path: Path) -> None:
    tables = page_of(tmp_path / "report.html", runs / "ucf", runs / "dt").tables
    best = tables["Runs"]["best validation loss"]
    for name in ("dt", "ucf"):
        record = record_of(runs / name)
        assert number(best[name]) == pytest.approx(record["policy"]["best_validation"], rel=1e-3)
    data = {name: cells["value"] for name, cells in tables["Training data"].items()}
    train = EpisodeStore.open(runs / "store").split("train")
    assert number(data["training sessions"]) == train.n_episodes == 90
    assert number(data["training steps"]) == train.lengths.sum()
    assert number(data["mean return of a session"]) == pytest.approx(train.returns.mean(), rel=1e-3)
    for level in (0.5, 0.9, 1.0):
        quantile = number(data[f"{level:.0%} of returns are at most"])
        assert quantile == pytest.approx(np.quantile(train.returns, level), rel=1e-3)
    (copies,) = (table for caption, table in tables.items() if "augmented episodes" in caption)
    report = record["augmentation"]
    model, moves = report["reward_model"], report["moves"]
    expected = {
        "copies": report["copies"],
        "acceptance": report["acceptance"],
        "bound": report["delta"] + report["epsilon_r"],
        "reward_model.z_share": model["z_share"],
        "moves.mean_move_ratio": moves["mean_move_ratio"],
    }
    for name, value in expected.items():
        assert number(copies[name]["ucf"]) == pytest.approx(value, rel=1e-3), name


def test_curves_are_what_was_logged_and_overlaid(runs: Path, tmp_path: Path) -> None:
    page = page_of(tmp_path / "report.html", runs / "ucf", runs / "dt")
    table = page.tables["Validation loss (action, held-out steps)"]
    logged = {name: read_metrics(runs / name / "policy") for name in ("ucf", "dt")}
    assert len(table) == 6
    for step, cells in table.items():
        for name, cell in cells.items():
            value = logged[name]["validation_loss"][int(step)]
            assert number(cell) == pytest.approx(value, rel=1e-3)
    attention = page.tables["Attention mass on the causal parents (1: all of it)"]
    assert [list(cells) for cells in attention.values()] == [["ucf"]] * 6
    labels = [str(given.get("aria-label")) for tag, given in page.elements if tag == "svg"]
    (label,) = (label for label in labels if label.startswith("Validation loss"))
    for name in ("ucf", "dt"):
        lowest = min(logged[name]["validation_loss"].values())
        assert re.search(rf"\b{name}: .*lowest {lowest:.4g} at", label)


def test_settings_that_differ_are_all_there_and_no_others(runs: Path, tmp_path: Path) -> None:
    page = page_of(tmp_path / "report.html", runs / "ucf", runs / "dt")
    table = page.tables["Settings that differ"]
    assert table["policy_name"] == {"ucf": "ucf", "dt": "dt"}
    assert table["augment.copies"] == {"ucf": "1", "dt": "0"}
    assert all(cells["ucf"] != cells["dt"] for cells in table.values())
    assert not {name for name in table if name.startswith(("train.", "crm.", "version."))}
    # Runs on other data are not compared.
    page = page_of(tmp_path / "report.html", runs / "ucf", runs / "other")
    assert page.text.count("Trained on ") == 2
    assert list(page.tables["Runs"]["seed"]) == ["other"]  # the last such table is other's alone
    assert "Settings that differ" not in page.tables


def test_the_page_stands_alone(runs: Path, tmp_path: Path) -> None:
    results = tmp_path / "rows.json"
    write_results(results, [row("taobao", "ucf", 3.0)])
    page = page_of(tmp_path / "report.html", runs / "ucf", results=(results,))
    links = [given["href"] for _, given in page.elements if "href" in given]
    assert all(str(link).startswith("#") for link in links)
    assert not [given for _, given in page.elements if given.keys() & {"src", "xlink:href"}]
    assert not {tag for tag, _ in page.elements} & {"script", "link", "iframe", "object", "img"}
    assert not re.search(r"url\((?!#)|https?:|@import", page.raw, re.IGNORECASE)
    policy = next(g for _, g in page.elements if "Security" in str(g.get("http-equiv")))
    assert str(policy["content"]).startswith("default-src 'none'")
    pictures = [given for tag, given in page.elements if tag == "svg"]
    assert all(p.get("aria-label") or p.get("aria-hidden") == "true" for p in pictures)


def test_names_from_outside_are_shown_and_never_run(runs: Path, tmp_path: Path) -> None:
    hostile = rewritten(runs / "ucf", tmp_path / HOSTILE.replace("/", "∕"), store=HOSTILE)
    record = record_of(hostile) | {"reward": HOSTILE}
    record["augmentation"]["warnings"] = [HOSTILE]
    (hostile / "run.json").write_text(json.dumps(record))
    results = tmp_path / "rows.jsonl"
    append_rows(results, [row(HOSTILE, HOSTILE, 1.0)])
    page = page_of(tmp_path / "report.html", hostile, results=(results,))
    assert not {tag for tag, _ in page.elements} & {"script", "img"}
    assert not [name for _, given in page.elements for name in given if name.startswith("on")]
    assert page.tables["Training data"]["reward"]["value"] == HOSTILE
    assert page.text.count(HOSTILE) >= 4


def test_doubts_come_first(runs: Path, tmp_path: Path) -> None:
    augmentation = record_of(runs / "ucf")["augmentation"]
    poor = augmentation | {"bound": 9.0, "verdict": "the bound means nothing", "warnings": ["leak"]}
    doubtful = rewritten(runs / "ucf", tmp_path / "doubtful", augmentation=poor)
    page = page_of(tmp_path / "report.html", doubtful)
    warnings = page.text[: page.text.index("Trained on")]
    assert all(text in warnings for text in ("leak", "the bound means nothing"))
    model = augmentation["reward_model"] | {"r2_without_z": 0.5}
    sound = augmentation | {"bound": 0.1, "warnings": [], "reward_model": model}
    believed = rewritten(runs / "ucf", tmp_path / "believed", augmentation=sound)
    assert "about the training" not in page_of(tmp_path / "report.html", believed).text


def test_a_killed_run_is_shown_as_far_as_it_got(runs: Path, tmp_path: Path) -> None:
    fields = {"policy": None, "augmentation": None}
    killed = rewritten(runs / "ucf", tmp_path / "killed", wall_time_s=0.0, **fields)
    metrics = killed / "policy" / METRICS
    metrics.write_bytes(metrics.read_bytes()[:-7])
    page = page_of(tmp_path / "report.html", killed)
    assert "not finished: logged up to step 25 of 30" in page.text
    shown = page.tables["Validation loss (action, held-out steps)"]
    assert list(shown) == ["5", "10", "15", "20", "25"]
    assert page.tables["Runs"]["best validation loss"] == {"killed": "–"}
    assert any("augmented episodes" in caption for caption in page.tables)
    metrics.unlink()
    assert "Nothing is logged yet" in page_of(tmp_path / "report.html", killed).text


def test_long_curves_are_thinned_to_their_end(runs: Path, tmp_path: Path) -> None:
    long = rewritten(runs / "dt", tmp_path / "long")
    log = MetricsLog(long / "policy", 0)
    for step in range(1, 1004):
        log.add(step, {"temperature": float("nan") if step == 500 else step / 7})
    log.close()
    table = page_of(tmp_path / "report.html", long).tables["temperature"]
    assert 100 < len(table) <= 200
    assert number(table["1003"]["long"]) == pytest.approx(1003 / 7, rel=1e-3)
    gaps = np.diff([int(step) for step in table])
    assert gaps.max() - gaps.min() <= 1  # but for the step that was not finite


def test_a_folder_that_is_no_run_is_named(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given, out = ["report", str(runs / "dt"), "--out"], tmp_path / "report.html"
    assert main([*given, str(out), str(runs / "store")]) == 2
    assert f"{runs / 'store'} is not a run folder" in capsys.readouterr().err
    assert main([*given, str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err
    assert main([*given, str(out)]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]

"""The forest plot draws what each verdict is of, and whether it stands."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.support.report_page import Page, row
from ucfrec.off_policy.estimators import LOGGED
from ucfrec.reporting.forest import forest, quoted
from ucfrec.reporting.page_results import Estimates, Results


def estimate(name: str, value: float | None, **more: Any) -> dict[str, Any]:
    found = row("", "ucf", value or 0.0, estimator=name, **more)
    return found | ({} if value is not None else {"R_cum_low": None, "R_cum_high": None})


def of(*estimates: Estimates) -> Results:
    return Results({}, estimates)


def test_a_line_a_policy_hollow_where_the_verdict_forbids() -> None:
    good = [estimate("IPS", 3.0), estimate("DR", 4.0, verdict_of="DR", reliable=True)]
    bad = [estimate("DR", 9.0, verdict_of="DR", reliable=False)]
    logged = estimate(LOGGED, 2.0)
    drawn = forest(of(Estimates("good", logged, good, ()), Estimates("bad", logged, bad, ())))
    assert drawn is not None
    assert [point.stands for point in drawn.points] == [True, False]
    first, second = drawn.points
    assert first.name == ("good: DR",)
    assert "95% interval 3.5 to 5.5, the estimate stands" in first.summary
    assert "do not rely on it" in second.summary
    assert first.low < first.at < first.high
    assert first.at < second.at
    assert first.y < second.y < drawn.height
    assert drawn.logged is not None
    assert drawn.logged < first.at


def test_without_an_interval_there_is_no_line() -> None:
    models = [estimate("DM", None), estimate("FQE", None)]
    assert forest(of(Estimates("ucf", estimate(LOGGED, 2.0), models, ()))) is None
    assert forest(of()) is None
    assert quoted([*models, estimate("SNIPS", 1.0)])["estimator"] == "SNIPS"


def test_logs_that_differ_have_no_common_reference() -> None:
    rows = [estimate("DR", 4.0)]
    drawn = forest(
        of(
            Estimates("a", estimate(LOGGED, 2.0), rows, ()),
            Estimates("b", estimate(LOGGED, 3.0), rows, ()),
        )
    )
    assert drawn is not None
    assert drawn.logged is None
    assert not any(point.stands for point in drawn.points)  # rows of before had no verdict


def test_rows_of_ope_are_drawn_in_the_report(folder: Path, tmp_path: Path) -> None:
    from ucfrec.reporting.estimate_rows import estimate_row
    from ucfrec.reporting.page import write_report

    about = {
        "choice": "softmax", "seed": 0, "fingerprint": "f", "checkpoint": "best", "command": "",
        "commit": None, "versions": {}, "target_return": 5.0, "rule": "r",
        "sessions": 10, "warnings": [],
        "verdict": "The policy earns more than the logged one: +2", "verdict_of": "DR",
        "reliable": True, "run": "runs/ucf",
    }  # fmt: skip
    rows = [
        estimate_row(
            estimate(name, value) | about | {"policy": policy},
            training_seed=0, config_hash="c",
        ).to_json()
        for name, policy, value in ((LOGGED, "behavior", 2.0), ("DR", "ucf", 4.0))
    ]  # fmt: skip
    (tmp_path / "ope.json").write_text(json.dumps(rows))
    write_report(tmp_path / "report.html", [folder / "ucf"], [tmp_path / "ope.json"])
    page = Page(tmp_path / "report.html")
    assert "For ucf (softmax) of runs/ucf: The policy earns more than the logged one" in page.text
    (group,) = [found for tag, found in page.elements if tag == "g" and found.get("class")]
    assert group["class"] == "stands"
    assert any(tag == "circle" for tag, _ in page.elements)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on random sessions."""
    from tests.recommending.test_recommend import SETTINGS, random_log
    from ucfrec import UCF, EpisodeStore
    from ucfrec.logs import LogMapping, PrepareOptions, prepare

    folder = tmp_path_factory.mktemp("forest")
    random_log().to_parquet(folder / "log.parquet")
    options = PrepareOptions(reward="reward", session_by="gap", gap_minutes=20)
    prepare([folder / "log.parquet"], LogMapping(), folder / "store", options)
    UCF(settings=SETTINGS).fit(EpisodeStore.open(folder / "store"), folder / "ucf")
    return folder

"""The demo, made small: every row there, in order, and resumed rather than repeated."""

from pathlib import Path

import pytest

from ucfrec.commands.cli import main
from ucfrec.commands.demo import BEHAVIORS, ENVIRONMENTS, FULL, SHARED, DemoConfig, conclusion, demo
from ucfrec.results.rows import read_results

TINY = DemoConfig(
    sessions=300,
    episodes=100,
    settings=("policy.dim=16", "train.steps=20", "crm.epochs=1", "rule.sessions=10"),
    methods=FULL.methods,
)


@pytest.mark.slow
def test_the_demo_writes_every_row_and_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = demo(tmp_path / "demo", seed=0, config=TINY)
    written = read_results(tmp_path / "demo" / "results.jsonl")
    assert {str(row) for row in written} == {str(row) for row in rows}
    page = (tmp_path / "demo" / "report.html").read_text()
    for environment in ENVIRONMENTS:
        assert f"{environment}: R_cum with" in page
        methods = {*TINY.methods} - ({SHARED} if environment == "synthetic-taobao" else set())
        of_environment = {row.method: row for row in rows if row.environment == environment}
        assert of_environment.keys() == methods | {*BEHAVIORS}
        assert max(of_environment.values(), key=lambda row: row.value).method == "optimal"
        for row in of_environment.values():
            assert row["R_cum_low"] <= row["R_cum"] <= row["R_cum_high"]
            assert row["R_avg_pooled"] == pytest.approx(row["R_cum"] / row["length"])
            assert (row.config_hash is None) == (row.training_seed is None)
            assert row.command
            assert row.versions
        for name in methods:
            assert f"<summary>{environment}/{name}: run.json</summary>" in page
        said = conclusion(environment, of_environment)
        assert f"UCF reaches {of_environment['ucf'].value:.3g} [" in said
        assert ("with the shared components" in said) == (SHARED in methods)
    weights = tmp_path / "demo" / ENVIRONMENTS[0] / "dt" / "policy" / "best.safetensors"
    written_at = weights.stat().st_mtime_ns
    monkeypatch.setattr("ucfrec.commands.demo.FULL", TINY)
    assert main(["demo", "--full", "--out", str(tmp_path / "demo")]) == 0
    again = read_results(tmp_path / "demo" / "results.jsonl")
    assert weights.stat().st_mtime_ns == written_at
    assert again == written

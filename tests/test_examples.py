"""The tutorials run, and show what they say they show."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from examples import control_policy, judge_three_ways, logs_to_recommendations

pytestmark = pytest.mark.slow


def test_recommendations_beat_the_logs_that_they_were_learned_from(tmp_path: Path) -> None:
    value = logs_to_recommendations.main(tmp_path)
    assert value["recommended"] > value["logged"] + 0.05
    assert value["logged"] > value["random"]


def test_the_three_ways_of_judging_are_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    played, estimated, ranked = judge_three_ways.main(tmp_path)
    earned = {row.method: row.value for row in played}
    assert earned["random"] < earned["bc"] < earned["ucf"] < earned["optimal"]
    weighted = estimated[estimated["estimator"] == "PDIS"]
    assert (weighted["effective_sessions"] < 100).all()  # what the text warns of
    printed = capsys.readouterr().out
    assert "effective of" in printed
    assert printed.count("Do not rely on this estimate") == 2
    rates = ranked.set_index("policy")
    assert rates.loc["ucf", "hit rate@10, clicked"] > rates.loc["ucf", "hit rate@10, shown"]


@pytest.mark.skipif(
    find_spec("h5py") is None or find_spec("mujoco") is None, reason="needs the extra control"
)
def test_asking_for_more_gives_more(tmp_path: Path) -> None:
    returns = [row["return"] for row in control_policy.main(tmp_path)]
    assert len(returns) == 3
    assert returns[-1] > 2 * returns[0]


def test_without_the_extra_control_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control_policy, "find_spec", lambda name: None)
    assert control_policy.main(tmp_path) == []
    assert "pip install '.[control]'" in capsys.readouterr().out

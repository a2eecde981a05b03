"""A search goes on where it ended, gives the same trials again, and writes what training takes."""

import json
import sqlite3
import tomllib
from collections.abc import Mapping
from pathlib import Path

import optuna
import pytest

from tests.recommending.test_recommend import random_log
from tests.support.logs import store_of
from ucfrec import EpisodeStore
from ucfrec.commands.cli import main
from ucfrec.errors import InputError
from ucfrec.runs.config import resolve_config
from ucfrec.runs.record import RunRecord
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.tuning.space import Dimension, Search
from ucfrec.tuning.study import BEST, Plan, format_toml, list_finished, measure_run, tune

FIXED = {
    **{"train.validate_every": 2, "policy.context": 3, "rule.sessions": 2},
    **{"rule.quantiles": [1.0], "rule.temperatures": [0.0]},
}
SPACE = {
    "train.learning_rate": Dimension(low=1e-3, high=1e-1, log=True),
    "train.steps": Dimension(low=2, high=6),
    "policy.dim": Dimension((4, 8)),
    "rule.reward_weights": Dimension((0.0, 2.0)),
}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tuning")
    store_of(random_log(), folder, session_by="gap", gap_minutes=20)
    return folder / "store"


def plan(store: Path, out: Path, policies: tuple[str, ...] = ("dt",), metric: str = "gauc") -> Plan:
    return Plan(store, out, Search(policies, FIXED, metric == "value", 0, SPACE), metric, k=5)


def alter(searched: Plan, statement: str) -> None:
    with sqlite3.connect(searched.out / "study.db") as study:
        study.execute(statement)


def values(study: optuna.Study) -> list[tuple[float | None, Mapping[str, object]]]:
    return [(trial.value, trial.params) for trial in list_finished(study)]


def test_the_reward_weight_of_a_trial_is_the_only_one_of_its_rules() -> None:
    searched = Search(("dt",), FIXED, False, 0, SPACE)
    rule = searched.config("dt", {"rule.reward_weights": 2.0}).rule
    assert (rule.reward_weights, rule.lookaheads) == ((2.0,), (0.0,))
    assert searched.config("dt", {"train.steps": 3}).rule.lookaheads != (0.0,)
    given = Search(("dt",), {**FIXED, "rule.lookaheads": [4.0]}, False, 0, SPACE)
    assert given.config("dt", {"rule.reward_weights": 2.0}).rule.lookaheads == (4.0,)


def test_the_best_trial_is_the_run_that_is_kept(store: Path, tmp_path: Path) -> None:
    searched = plan(store, tmp_path / "tuned", ("dt", "item-rate"), "ndcg")
    study = tune(searched, 4)
    assert len(list_finished(study)) == 4
    left = {path.name for path in searched.out.iterdir()}
    assert left == {BEST, "best.toml", "tuning.md", "study.db", "stages"}
    trained = TrainedPolicy.load(searched.out / BEST)
    assert measure_run(trained, EpisodeStore.open(store), "ndcg", 5) == study.best_value
    assert study.best_value == max(t.value for t in study.trials if t.state.name == "COMPLETE")


@pytest.mark.slow
def test_a_search_goes_on_and_gives_the_same_trials(store: Path, tmp_path: Path) -> None:
    first = values(tune(plan(store, tmp_path / "a"), 3))
    assert values(tune(plan(store, tmp_path / "a"), 3)) == first  # nothing is left to do
    more = values(tune(plan(store, tmp_path / "a"), 5))
    assert more[:3] == first
    assert len({json.dumps(params) for _, params in more}) == 5
    assert values(tune(plan(store, tmp_path / "b"), 3)) == first
    with pytest.raises(InputError, match="is a search with another metric;"):
        tune(plan(store, tmp_path / "a", metric="value"), 6)


@pytest.mark.slow
def test_two_workers_share_the_trials(store: Path, tmp_path: Path) -> None:
    assert len(list_finished(tune(plan(store, tmp_path / "tuned"), 4, workers=2))) == 4
    assert (tmp_path / "tuned" / BEST / RunRecord.FILE).exists()


def test_a_killed_trial_is_run_again_in_a_folder_of_any_name(store: Path, tmp_path: Path) -> None:
    searched = plan(store, tmp_path / "a%2F{b}?c#[1]")
    tune(searched, 1)
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == [searched.out.name]
    # As a process that was killed leaves it.
    alter(searched, "UPDATE trials SET state = 'RUNNING', datetime_complete = NULL")
    alter(searched, "DELETE FROM trial_values")
    resumed = tune(searched, 1)
    assert [trial.state.name for trial in resumed.trials] == ["FAIL", "COMPLETE"]
    assert resumed.trials[0].params == resumed.trials[1].params
    alter(searched, "UPDATE trials SET state = 'LOST'")
    with pytest.raises(InputError, match=r"study\.db is damaged \(LookupError: 'LOST' is not"):
        tune(searched, 1)
    (searched.out / "study.db").write_bytes(bytes(5000))
    with pytest.raises(InputError, match=r"study\.db cannot be read .*file is not a database"):
        tune(searched, 1)


def test_hopeless_trials_end_early(store: Path, tmp_path: Path) -> None:
    rates = {"train.learning_rate": Dimension((0.03, 1e-6))}
    rates["policy.dropout"] = Dimension(low=0.0, high=0.5)
    fixed = FIXED | {"train.steps": 12, "policy.dim": 8, "rule.choose": False}
    search = Search(("dt",), fixed, False, 0, rates)
    study = tune(Plan(store, tmp_path / "tuned", search, "gauc", 5), 9)
    ended = [trial for trial in study.trials if trial.state.name == "PRUNED"]
    assert ended
    assert all(max(trial.intermediate_values) <= 12 for trial in ended)
    assert study.trials.index(ended[0]) >= 4


@pytest.mark.parametrize("text", ["it's", '"it\'s"\\n', "a\nb\t\x7f\x01é", ""])
def test_texts_are_written_as_they_are(text: str) -> None:
    assert tomllib.loads(f"x = [{format_toml(text)}]") == {"x": [text]}


def test_the_command_writes_settings_that_train_takes(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    space = tmp_path / "space.toml"
    space.write_text("[train]\nsteps = [2, 3]\n[policy]\ndropout = {low = 0.0, high = 0.2}\n")
    fixed = [f"--set={name}={value}" for name, value in FIXED.items()]
    out, more = tmp_path / "tuned", [*fixed, "--set", "policy.dim=8", "--space", str(space)]
    assert main(f"tune {store} --out {out} --policy dt --trials 4".split() + more) == 0
    assert "next: ucfrec ope" in capsys.readouterr().out
    assert tomllib.loads((out / "best.toml").read_text("utf-8"))["policy"]["dim"] == 8
    assert resolve_config("dt", out / "best.toml") == RunRecord.read(out / BEST).config
    assert (out / "tuning.md").read_text(encoding="utf-8").count("\n| ") >= 4


def test_what_cannot_be_searched(store: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"policy.dim is 0"):
        Search(("dt",), {}, True, 0, {"policy.dim": Dimension((0,))})
    with pytest.raises(InputError, match="no policy is called 'nothing'"):
        Search(("nothing",), {}, True, 0)
    for values_of, message in (
        ({}, "give a list of choices, or low and high"),
        ({"low": 2, "high": 1}, "give the lower one first"),
        ({"low": 0.0, "high": 1.0, "log": True}, "above 0 with log"),
    ):
        with pytest.raises(InputError, match=message):
            Dimension(**values_of)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="0 trials and 1 workers"):
        tune(plan(store, tmp_path / "tuned"), 0)
    store_of(random_log().assign(reward=1.0), tmp_path, session_by="gap", gap_minutes=20)
    for choose, of in ((False, store), (True, tmp_path / "store")):
        search = Search(("item-rate",), {"rule.choose": choose}, True, 0)
        with pytest.raises(InputError, match=r"item-rate has no estimated value.*--metric ndcg"):
            tune(Plan(of, tmp_path / "tuned", search), 1)
    assert not (tmp_path / "tuned").exists()
    # Nothing is proposed that needs rewards that differ.
    search = Search(("dt",), FIXED | {"train.steps": 2, "policy.dim": 4}, False, 0)
    study = tune(Plan(tmp_path / "store", tmp_path / "tuned", search, "ndcg"), 2)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 2
    best = RunRecord.read(tmp_path / "tuned" / BEST).ranking
    assert best.ndcg == pytest.approx(study.best_value)  # `train` measures it as `rank` does

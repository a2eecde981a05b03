"""Training without columns that cause nothing is training without them, also when acting."""

from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from tests.support.causes import planted_items, planted_vectors
from tests.support.tensors import assert_same_tensors
from ucfrec.commands.cli import main
from ucfrec.counterfactual.screening import DimensionReport, ScreeningReport
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.writer import read_observations, write_observations
from ucfrec.errors import InputError
from ucfrec.files.atomic import read_json
from ucfrec.runs import screened
from ucfrec.runs.config import resolve_config
from ucfrec.runs.record import RunRecord
from ucfrec.runs.refit import refit
from ucfrec.runs.screened import train_screened
from ucfrec.runs.trained_policy import TrainedPolicy

SETTINGS = ["train.steps=4", "train.validate_every=2", "policy.dim=8", "policy.context=3"]
SETTINGS += ["rule.choose=false", "augment.copies=1", "crm.epochs=1", "csg.epochs=1"]
FLAGGED = (0, 4)


def verdicts(flagged: Sequence[int]) -> Callable[[EpisodeStore, int], ScreeningReport]:
    """A screening that flags these columns."""

    def screen(store: EpisodeStore, seed: int) -> ScreeningReport:
        found = [
            DimensionReport(d, measures_reward=d in flagged, causes=d not in flagged)
            for d in range(store.observation_size)
        ]
        return ScreeningReport(tuple(found), None, 100)

    return screen


@pytest.fixture(autouse=True)
def _known_verdicts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Screening itself is tested in `tests/counterfactual`; here its verdicts are given."""
    monkeypatch.setattr(screened, "screen_store", verdicts(FLAGGED))


@pytest.mark.parametrize("items", [True, False], ids=["items", "vectors"])
def test_what_is_dropped_might_never_have_been_logged(items: bool, tmp_path: Path) -> None:
    plant = planted_items if items else planted_vectors
    store = plant(tmp_path / "store", 30, 8)
    kept = np.delete(read_observations(store), FLAGGED, axis=1)
    never = write_observations(store, tmp_path / "never", kept, {})
    config = resolve_config("ucf", None, SETTINGS)
    record = train_screened(store, tmp_path / "dropped", config, "drop")
    plain = train_screened(never, tmp_path / "plain", config, None)
    assert record.dropped_observations == FLAGGED
    assert record.sizes == plain.sizes
    names = ("augmented", "policy/last", "policy/best")
    assert_same_tensors(tmp_path / "dropped", tmp_path / "plain", *names)
    # The actor is shown everything that was logged, and sees what is left.
    seen = np.random.default_rng(0).normal(size=(6, 5)).astype(np.float32)
    numbers = np.arange(8) if items else None
    decided = []
    for run, shown in (("dropped", seen), ("plain", np.delete(seen, FLAGGED, axis=1))):
        actor = TrainedPolicy.load(tmp_path / run).actor(6, item_numbers=numbers)
        actor.begin(np.arange(6))
        decided.append(actor.act(shown, np.ones(6, dtype=bool))[0])
    np.testing.assert_array_equal(*decided)


def test_a_run_goes_on_as_it_was_started_and_is_refitted_so(tmp_path: Path) -> None:
    store = planted_items(tmp_path / "store", 30, 8)
    config = resolve_config("bc", None, SETTINGS)
    record = train_screened(store, tmp_path / "run", config, "drop")
    again = train_screened(store, tmp_path / "run", config, "drop")
    assert (again.screening, again.policy) == (record.screening, record.policy)
    for other in ("copies", None):
        with pytest.raises(InputError, match="was started with --screen drop"):
            train_screened(store, tmp_path / "run", config, other)
    whole = refit(store, tmp_path / "run", tmp_path / "whole")
    assert whole.sizes == record.sizes
    assert TrainedPolicy.load(tmp_path / "whole").record.dropped_observations == FLAGGED


def test_runs_that_share_stages_are_screened_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    screened_stores = []

    def screen(store: EpisodeStore, seed: int) -> ScreeningReport:
        screened_stores.append((store.path, seed))
        return verdicts(FLAGGED)(store, seed)

    monkeypatch.setattr(screened, "screen_store", screen)
    stores = [planted_items(tmp_path / str(n), n, 8) for n in (30, 31)]
    shared, found = tmp_path / "stages", []
    for store, how, seed in product(stores, ("copies", "drop"), (0, 1)):
        config = resolve_config("bc", None, SETTINGS, seed)
        out = tmp_path / f"{store.path.name}-{how}-{seed}"
        found.append(train_screened(store, out, config, how, shared=shared).screening)
    assert screened_stores == [(store.path, 0) for store in stores]
    assert [each and each.how for each in found[:3]] == ["copies", "copies", "drop"]
    assert found[0] == found[1]
    record = RunRecord.read(tmp_path / "30-copies-0")
    assert (record.dropped_observations, record.sizes["state"]) == ((), stores[0].state_size)


def test_screening_that_leaves_no_state_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(screened, "screen_store", verdicts(range(5)))
    store = planted_vectors(tmp_path / "store", 30, 8)
    with pytest.raises(InputError, match="no effect of any of the 5 state dimensions"):
        train_screened(store, tmp_path / "run", resolve_config("bc", None, SETTINGS), "drop")
    assert not (tmp_path / "run").exists()


def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    planted_items(tmp_path / "store", 30, 8)
    store, report = str(tmp_path / "store"), tmp_path / "report.json"
    assert main(["screen", store, "--json", str(report)]) == 0
    assert "dimensions without effect: 0, 4" in capsys.readouterr().out
    assert [d["causes"] for d in read_json(report)["dimensions"]] == [False, *[True] * 3, False]
    settings = [argument for setting in SETTINGS for argument in ("--set", setting)]
    run = ["train", store, "--out", str(tmp_path / "run"), "--policy", "bc", "--screen", "drop"]
    assert main([*run, *settings]) == 0
    assert "observation columns without effect: 0, 4" in capsys.readouterr().out

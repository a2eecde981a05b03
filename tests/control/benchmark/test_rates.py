"""Learning rates are chosen on validation loss alone, and the chosen ones are trained with."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.control_files import hopper_like, write_hdf5
from tests.support.result_rows import read_configurations, result_row
from ucfrec.benchmark.cells import Budget, Evaluation
from ucfrec.errors import InputError
from ucfrec.results.row import ResultRow
from ucfrec.results.rows_file import read_rows
from ucfrec_control.benchmark import rates
from ucfrec_control.benchmark.budgets import BUDGETS, TRIED_RATES
from ucfrec_control.benchmark.methods import METHODS, TABLES, WITH_TIME
from ucfrec_control.benchmark.rates import (
    SEARCHED,
    best_rates,
    chosen_rates,
    read_rates,
    settings_of,
    write_rates,
)
from ucfrec_control.cli import main
from ucfrec_control.training.rl_baselines import ALGORITHMS

SHORT = ("train.steps=4", "train.validate_every=2")


def of_rate(method: str, task: str, rate: float, loss: float) -> ResultRow:
    return result_row(
        loss,
        metric="validation_loss",
        task=task,
        method=method,
        training_seed=0,
        conditions={"budget": "small", "learning_rate": rate},
    )


def test_a_file_with_larger_losses_weighs_no_more() -> None:
    # At 0.1 a fifth is lost on the one file; at 0.2 only a tenth, on the other with large losses.
    rows = [
        of_rate("dt", "small", 0.1, 0.012), of_rate("dt", "small", 0.2, 0.010),
        of_rate("dt", "large", 0.1, 10.0), of_rate("dt", "large", 0.2, 11.0),
        of_rate("dc", "small", 0.1, 1.0), of_rate("dc", "small", 0.2, 3.0),
    ]  # fmt: skip
    assert best_rates(rows) == {"dt": 0.2, "dc": 0.1}


def test_every_policy_has_a_rate() -> None:
    assert {name: METHODS[name] for name in SEARCHED} == SEARCHED
    policies = {method.policy for method in METHODS.values()}
    assert sorted(method.policy for method in SEARCHED.values()) == sorted(policies)
    assert not SEARCHED.keys() & set(WITH_TIME)
    assert chosen_rates("small").keys() <= SEARCHED.keys()
    assert set(chosen_rates("small").values()) <= set(TRIED_RATES["small"])
    assert chosen_rates("unknown") == {}


@pytest.mark.parametrize("table", TABLES)
def test_every_row_is_trained_at_the_rate_of_its_policy(
    table: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = {name: float(number) for number, name in enumerate(SEARCHED, start=1)}
    monkeypatch.setattr(rates, "chosen_rates", lambda budget: numbers)
    for name, method in TABLES[table].items():
        found = settings_of(BUDGETS["full"], name, method)
        tried = next(m for m, each in SEARCHED.items() if each.policy == method.policy)
        if method.policy in ALGORITHMS:
            assert found == ("steps=1000000", f"learning_rate={numbers[tried]:g}")
            continue
        assert f"train.learning_rate={numbers[tried]:g}" in found, name
        own = (*method.settings, *BUDGETS["full"].of_methods.get(name, ()))
        assert found[-len(own) :] == own if own else True


def test_a_method_with_a_rate_of_its_own_is_trained_at_it() -> None:
    budget = replace(BUDGETS["small"], rates={"dt": 0.5, "dt-wo-time": 0.25, "ucf": 0.125})
    for name, rate in (("dt", 0.5), ("dt-wo-time", 0.25), ("ucf-w-time", 0.125)):
        assert f"train.learning_rate={rate:g}" in settings_of(budget, name, METHODS[name])
    given = [each for each in budget.settings if each.startswith("train.learning_rate")]
    found = settings_of(budget, "dc", METHODS["dc"])
    assert [each for each in found if each.startswith("train.learning_rate")] == given


def test_the_search_writes_rows_and_a_choice_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_hdf5(tmp_path / "hopper_medium-made.hdf5", hopper_like((30, 8, 25) * 8))
    settings = ("train.batch_size=4", "train.warmup_steps=0", "policy.dim=16", "policy.context=3")
    tiny = Budget("small", ("hopper_medium-made",), 1, Evaluation(1, 1000), settings)
    monkeypatch.setitem(BUDGETS, "small", tiny)
    monkeypatch.setitem(TRIED_RATES, "small", (1e-9, 1e-2))
    out, toml = tmp_path / "out", tmp_path / "rates.toml"
    arguments = ["rates", "--data", str(tmp_path), "--out", str(out), "--toml", str(toml)]
    arguments += ["--method", "dt-wo-time", "--steps", "30"]
    assert main(arguments) == 0
    rows = read_rows(out / "results.jsonl")
    assert [row.conditions["learning_rate"] for row in rows] == [1e-9, 1e-2]
    assert rows[1].value < rows[0].value
    assert toml.read_text() == "[small]\ndt-wo-time = 0.01\n"
    assert main(arguments) == 0
    assert read_rows(out / "results.jsonl") == rows
    assert "0 of them left" in capsys.readouterr().err
    # A rehearsal with fewer steps is not part of the search.
    assert main([*arguments[:-1], "2", "--toml", str(tmp_path / "rehearsed.toml")]) == 0
    assert main(["rates", "--out", str(out), "--show-only"]) == 0
    assert "2 of them left" in (printed := capsys.readouterr()).err
    assert "dt-wo-time = 0.01" in printed.out.split("[small]")[-1]
    # The choice is what the benchmark trains with.
    given = ["benchmark", "--data", str(tmp_path), "--out", str(out), "--method", "dt-wo-time"]
    given += ["--rates", str(toml)]
    monkeypatch.setitem(BUDGETS, "small", replace(tiny, settings=(*settings, *SHORT)))
    assert main(given) == 0
    assert "chosen on validation loss: dt-wo-time 0.01" in capsys.readouterr().out
    trained = [row for row in read_rows(out / "results.jsonl") if row.suite == "control"]
    configurations = read_configurations(out)
    assert {configurations[str(row.config_hash)]["train"]["learning_rate"] for row in trained} == {
        0.01
    }


def test_a_file_of_rates_keeps_its_other_rates_and_is_checked(tmp_path: Path) -> None:
    file = tmp_path / "rates.toml"
    write_rates(file, "full", {"dt": 1e-4})
    write_rates(file, "small", {"dt": 1e-2, "ucf": 3e-3})
    write_rates(file, "full", {"dt": 2e-4, "iql": 1e-3})
    write_rates(file, "full", {"dt": 3e-4})
    assert read_rates(file) == {
        "full": {"dt": 3e-4, "iql": 1e-3},
        "small": {"dt": 0.01, "ucf": 0.003},
    }
    for text, says in (
        ("[small]\nnone = 0.1\n", "'none' = 0.1 is not a learning rate of a method"),
        ("[small]\ndt = 7\n", "'dt' = 7 is no"),
        ("small = 1\n", "'small' = 1 is no"),
        ("[", "is not TOML"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=says):
            read_rates(file)
    with pytest.raises(InputError, match="does not exist"):
        read_rates(tmp_path / "missing.toml")
    # Untrusted rows may name methods of any text.
    with pytest.raises(InputError, match="is not a learning rate of a method"):
        write_rates(tmp_path / "new.toml", "small", {"dt\n[full]\nx": 0.1})
    assert not (tmp_path / "new.toml").exists()


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 100_000,
        "[small]\nucf = " + "1" * 5000,
        "['a b']\nucf = 0.1",
        "[small]\nucf = nan",
    ],
)
def test_a_strangers_rates_are_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "rates.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=r"rates\.toml"):
        read_rates(file)


def test_a_file_without_validation_trajectories_is_refused_before_a_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_hdf5(tmp_path / "hopper_medium-made.hdf5", hopper_like((30, 8)))
    asked = ["rates", "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*asked, "--file", "hopper_medium-made"]) == 2
    assert "too few trajectories for validation" in capsys.readouterr().err
    assert not list((tmp_path / "out").rglob("run.json"))

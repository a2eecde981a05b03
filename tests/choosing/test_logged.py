"""Evidence of logged sessions is what `ope` finds in them, and the choice keeps to it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.tagged import tagged_store
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import logged_scores
from ucfrec.choosing.by_simulation import RuleSearch, choose_by_simulation
from ucfrec.choosing.choice import Problem, RuleConfig
from ucfrec.choosing.logged import LoggedEvidence
from ucfrec.episodes.store import EpisodeStore
from ucfrec.off_policy.diagnostics import diagnose
from ucfrec.off_policy.estimators import estimate
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec.reporting.model_card import tabulate_user_model
from ucfrec.reporting.results import draw_frontier
from ucfrec.runs.config import resolve_config
from ucfrec.runs.record import RunRecord, read_candidates
from ucfrec.runs.run import train_run
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import REWARD_MODEL, TrainedPolicy
from ucfrec.user_model.model import UserModel

SETTINGS = ["train.steps=5", "policy.dim=16", "policy.context=4", "augment.copies=0"]
RULE = ["rule.sessions=20", "rule.least_items=2.0", "rule.least_impressions=1"]
ITEMS = 24


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on a log that shows any item alike, and says so."""
    folder = tmp_path_factory.mktemp("evidence")
    store = tagged_store(folder, propensity=1 / ITEMS)
    settings = [*SETTINGS, *RULE, "rule.evidence=3"]
    train_run(store, folder / "run", resolve_config("dt", None, settings))
    return folder


def problem(folder: Path, evidence: int) -> Problem:
    views = training_views(EpisodeStore.open(folder / "store"))
    trained = TrainedPolicy.load(folder / "run")
    config = RuleConfig(
        sessions=20, evidence=evidence, least_items=2, least_impressions=1, tag_windows=(0,)
    )
    users = UserModel.fit(*views, folder / "run" / REWARD_MODEL, 0)
    targets = {quantile: trained.target_return(quantile) for quantile in config.quantiles}
    return Problem(trained.scorer(DecisionRule(2.0)), users, targets, *views, config, 0)


def test_evidence_is_what_off_policy_evaluation_finds(folder: Path) -> None:
    given = problem(folder, 3)
    rules = [
        DecisionRule(2.0, temperature=2.0, reward_weight=0.5),
        DecisionRule(1.0, minimum_target=1.0, temperature=8.0),
        DecisionRule(2.0, lookahead=1.0, reward_weight=1.0),
    ]
    view = given.validation
    found = LoggedEvidence(given.scorer, view, 10**6, 0).of(rules)
    episodes, steps = view.all_steps()
    items = view.step_values("item", episodes, steps)
    rewards = view.step_values("reward", episodes, steps).astype(np.float64)
    user = np.unique(view.episode_values("user"), return_inverse=True)[1]
    for rule, evidence in zip(rules, found, strict=True):
        scores = logged_scores(given.scorer.under(rule), view, episodes, steps)
        logs = rule.log_probabilities(scores).double().numpy()[np.arange(len(items)), items]
        logged = LoggedSteps(
            episodes, rewards, np.full(len(items), 1 / ITEMS), np.exp(logs), user=user
        )
        assert evidence.likelihood == pytest.approx(np.exp(logs.mean()), rel=1e-5)
        assert evidence.effective_users is not None
        if not np.exp(logs).any() or rule.temperature == 0:
            assert evidence.effective_users == pytest.approx(0.0, abs=2)
            continue
        expected = estimate(logged, 0)["SNIPS"]
        assert evidence.value == pytest.approx(expected.value, rel=1e-4)
        assert expected.error is not None
        assert evidence.error == pytest.approx(expected.error, rel=0.05)
        whole = diagnose(logged).effective_users
        assert 0.3 * whole < evidence.effective_users < 1.5 * whole
    assert found[1].effective_users > found[0].effective_users > found[2].effective_users


def test_only_rules_that_the_log_can_evaluate_are_chosen(folder: Path) -> None:
    free, bound = (choose_by_simulation(problem(folder, each)) for each in (0, 12))
    assert all(each.rule in {one.rule for one in bound.candidates} for each in free.candidates)
    chosen = next(each for each in bound.candidates if each.rule == bound.rule)
    assert chosen.effective_users >= 12
    assert chosen.value <= max(each.value for each in bound.candidates)
    best = max(bound.candidates, key=lambda each: each.value)
    assert best.effective_users < 12
    search = RuleSearch(problem(folder, 10**6))
    tried = search.simulate([each.rule for each in bound.candidates])
    assert not any(search.is_allowed(each) for each in tried)
    assert set(search.level(tried)) <= {*filter(search.is_supported, tried)}
    assert chosen.evidence is not None
    known = replace(chosen, evidence=replace(chosen.evidence, effective_users=1e6))
    assert search.level([*tried, known]) == [known]
    assert "too small to evaluate" in choose_by_simulation(problem(folder, 10**6)).warning


def test_the_report_draws_what_a_bolder_rule_would_gain(folder: Path) -> None:
    record, candidates = RunRecord.read(folder / "run"), read_candidates(folder / "run")
    assert record.rule is not None
    found, table = draw_frontier(record, candidates), tabulate_user_model(record)
    assert found is not None
    assert table is not None
    values = [float(cells[0]) for _, cells in found[1].rows]
    users = [float(cells[1]) for _, cells in found[1].rows]
    assert values == sorted(values)
    assert users == sorted(users, reverse=True)
    best = max(each.value or 0.0 for each in candidates)
    assert values[-1] == pytest.approx(best, rel=1e-3)
    parts = dict(table.rows)
    estimate_of_run = record.rule.estimate
    assert estimate_of_run is not None
    assert parts["estimated value"][0].startswith(f"{estimate_of_run.value:.4g} ±")
    assert "±" in parts["rewards expected too high by"][0]

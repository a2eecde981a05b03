"""What rules would have done at logged steps is what `ope` and each rule alone find; it decides."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support.logs import store_of
from tests.support.tagged import tagged_log, tagged_mapping, tagged_store
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Query, Scorer, logged_scores
from ucfrec.choosing import by_ranking
from ucfrec.choosing.by_ranking import SHOWN, LoggedEvidence, LoggedOutcomes, choose_by_ranking
from ucfrec.choosing.by_simulation import RuleSearch, _batch_rules, choose_by_simulation
from ucfrec.choosing.choice import Problem, RankedRule, RuleChoice, RuleConfig
from ucfrec.episodes.states import TrainingCounts, liked_rewards
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.atomic import read_json
from ucfrec.off_policy.estimators import estimate
from ucfrec.off_policy.logged_steps import LoggedSteps
from ucfrec.off_policy.verdict import diagnose
from ucfrec.policies.heads import ItemHead
from ucfrec.reporting.model_card import describe_user_model
from ucfrec.runs.config import resolve_config
from ucfrec.runs.record import RunRecord
from ucfrec.runs.run import train_run
from ucfrec.runs.start import continue_users, training_views
from ucfrec.runs.trained_policy import REWARD_MODEL, TrainedPolicy
from ucfrec.user_model.model import UserModel

SETTINGS = ["train.steps=5", "policy.dim=16", "policy.context=4", "augment.copies=0"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ranking")
    options = {"reward": "reward", "session_by": "user", "embedding_size": 6}
    store = store_of(tagged_log(), folder, tagged_mapping(folder), **options)
    train_run(store, folder / "run", resolve_config("ucf", None, SETTINGS))
    return folder


def chosen(folder: Path, liked_bias: float, *weights: float) -> RuleChoice:
    """The choice for a policy that shows the ten most liked items by their bias."""
    views = training_views(EpisodeStore.open(folder / "store"))
    liked = TrainingCounts.of(views[0]).liked.topk(10).indices
    trained = TrainedPolicy.load(folder / "run")
    policy = copy.deepcopy(trained.policy)
    assert isinstance(policy.head, ItemHead)
    with torch.no_grad():
        policy.head.bias.copy_(torch.zeros(24).index_fill(0, liked, liked_bias))
    scorer, config = replace(trained, policy=policy).scorer(), RuleConfig(reward_weights=weights)
    users = UserModel.fit(*views, folder / "um", 0)
    return choose_by_ranking(Problem(scorer, users, {}, *views, config, 0))


def test_all_reward_weights_at_once_are_evaluated_as_each_rule_alone(folder: Path) -> None:
    trained = TrainedPolicy.load(folder / "run")
    train, validation = training_views(EpisodeStore.open(folder / "store"))
    validation = continue_users(validation, train)  # as users have been shown the training rows
    episodes, steps = validation.all_steps()
    assert (steps > 0).all()
    liked = liked_rewards(validation, validation.column("reward"))
    items = validation.step_values("item", episodes, steps)
    candidates = read_json(folder / "run" / "candidates.json")
    assert len({each["rule"]["reward_weight"] for each in candidates}) == len(candidates) > 2
    for each in candidates:
        scorer = trained.scorer(replace(trained.rule, reward_weight=each["rule"]["reward_weight"]))
        scores = logged_scores(scorer, validation, episodes, steps)
        top = scores.topk(SHOWN).indices.numpy()
        hits = (top == items[:, None]).any(1)[liked].mean()
        assert each["hits"] == pytest.approx(float(np.asarray(hits)), abs=1e-9)


def test_reward_weights_below_the_first_that_overlaps_too_little_are_ranked(folder: Path) -> None:
    found, candidates = chosen(folder, 50.0, 0.0, 1000.0)
    ranked = [each for each in candidates if isinstance(each, RankedRule)]
    overlaps = {each.rule.reward_weight: each.overlaps for each in ranked}
    assert [*overlaps.items()][:2] == [(0.0, True), (1000.0, False)]
    assert overlaps[found.rule.reward_weight]
    assert not found.warning
    too_large = min(weight for weight, enough in overlaps.items() if not enough)
    largest = max(weight for weight, enough in overlaps.items() if enough)
    assert too_large - largest == 1000 / 2 ** (len(overlaps) - 2)


def test_scores_in_memory_do_not_grow_with_the_catalogue(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, score = set[int](), Scorer.scores_of

    def score_and_count(scorer: Scorer, query: Query, **options: Any) -> Tensor:
        rows.add(len(query.items))
        return score(scorer, query, **options)

    monkeypatch.setattr(Scorer, "scores_of", score_and_count)
    expected = chosen(folder, 50.0, 0.0, 1.0)
    monkeypatch.setattr(by_ranking, "_SCORES_AT_ONCE", 24 * 3)
    rows.clear()
    assert chosen(folder, 50.0, 0.0, 1.0) == expected
    assert max(rows) == 3
    parts = [[(0, slice(0, 2))], [(0, slice(2, 3))], [(2, slice(3, 5))]]
    assert _batch_rules(np.array([0, 0, 0, 2, 2]), 2) == parts


def test_without_overlap_a_rule_hits_as_often_as_any_and_says_so(folder: Path) -> None:
    found, candidates = chosen(folder, -1e4, 0.0, 1.0)
    ranked = [each for each in candidates if isinstance(each, RankedRule)]
    assert not any(each.overlaps for each in ranked)
    most = max(ranked, key=lambda each: each.gain)
    enough = most.gain - most.gain_error
    assert found.rule in [each.rule for each in ranked if each.gain >= enough]
    assert "WARNING" in found.warning


def test_of_rules_of_the_highest_value_the_one_with_the_most_hits_is_chosen() -> None:
    few, many, poor, lossy = (DecisionRule(1.0, reward_weight=weight) for weight in range(4))
    users, liked = np.arange(40), np.ones(40, dtype=bool)
    hits = {few: users < 10, many: users < 20, poor: users < 40, lossy: users < 8}
    values = {few: 0.5, many: 0.5, poor: 0.1, lossy: 0.9}
    rows = {rule: np.full(40, value) for rule, value in values.items()}
    outcomes = LoggedOutcomes(users, liked, users < 2, 0.9, hits, rows)
    assert outcomes.choose().rule is many
    assert [rule.overlaps for rule in outcomes.rank()] == [True, True, True, False]
    assert outcomes._replace(keep_hits=0.5).choose().rule is lossy
    backwards = {rule: hits[rule] for rule in reversed(hits)}
    assert outcomes._replace(hits=backwards).choose().rule is many


RULE = ["rule.sessions=20", "rule.least_items=2.0", "rule.least_impressions=1"]
ITEMS = 24


@pytest.fixture(scope="module")
def evident(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on a log that shows any item alike, and says so."""
    folder = tmp_path_factory.mktemp("evidence")
    store = tagged_store(folder, propensity=1 / ITEMS)
    settings = [*SETTINGS, *RULE, "rule.evidence=3"]
    train_run(store, folder / "run", resolve_config("dt", None, settings))
    return folder


def problem(evident: Path, evidence: int) -> Problem:
    views = training_views(EpisodeStore.open(evident / "store"))
    trained = TrainedPolicy.load(evident / "run")
    least = {"evidence": evidence, "least_items": 2, "least_impressions": 1}
    config = RuleConfig(sessions=20, tag_windows=(0,), **least)
    users = UserModel.fit(*views, evident / "run" / REWARD_MODEL, 0)
    targets = {quantile: trained.target_return(quantile) for quantile in config.quantiles}
    return Problem(trained.scorer(DecisionRule(2.0)), users, targets, *views, config, 0)


def test_evidence_is_what_off_policy_evaluation_finds(evident: Path) -> None:
    given = problem(evident, 3)
    rules = [
        DecisionRule(2.0, temperature=2.0, reward_weight=0.5),
        DecisionRule(1.0, minimum_target=1.0, temperature=8.0),
        DecisionRule(2.0, lookahead=1.0, reward_weight=1.0),
    ]
    view = given.validation
    found = LoggedEvidence(given.scorer, view, 10**6, 0).evaluate(rules)
    episodes, steps = view.all_steps()
    items = view.step_values("item", episodes, steps)
    rewards = view.step_values("reward", episodes, steps).astype(np.float64)
    user = np.unique(view.episode_values("user"), return_inverse=True)[1]
    for rule, evidence in zip(rules, found, strict=True):
        scores = logged_scores(given.scorer.under(rule), view, episodes, steps)
        logs = rule.log_probabilities(scores).double().numpy()[np.arange(len(items)), items]
        shown = np.full(len(items), 1 / ITEMS)
        logged = LoggedSteps(episodes, rewards, shown, np.exp(logs), user=user)
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


def test_rows_of_a_list_are_drawn_one_after_the_other(evident: Path, tmp_path: Path) -> None:
    log = tagged_log().assign(propensity=1 / ITEMS)
    pairs = ["user_id", log.groupby("user_id").cumcount() // 2]
    log["timestamp"] = log.groupby(pairs).timestamp.transform("first")
    log = log[~log.duplicated(["timestamp", "item_id"])]
    options = {"reward": "reward", "session_by": "user", "embedding_size": 6}
    view = store_of(log, tmp_path, tagged_mapping(tmp_path), **options).split("validation")
    rule = DecisionRule(2.0, temperature=0.5)
    scorer = TrainedPolicy.load(evident / "run").scorer(rule)
    (found,) = LoggedEvidence(scorer, view, 10**6, 0).evaluate([rule])
    rows, items = np.arange(view.n_steps), view.column("item").astype(int)
    logs = rule.log_probabilities(logged_scores(scorer, view, *view.all_steps())).numpy()
    second = view.column("place") == 1
    left = -np.expm1(logs[rows, np.roll(items, 1)])
    logs = logs[rows, items] - np.where(second, np.log(left), 0.0) + np.log(ITEMS)
    weights = np.exp(np.bincount(view.all_steps()[0], logs))
    assert found.value == pytest.approx(weights @ view.returns / weights.sum(), rel=1e-4)
    assert second.sum() > 30


def test_only_rules_that_the_log_can_evaluate_are_chosen(evident: Path) -> None:
    (_, free), (found, bound) = (choose_by_simulation(problem(evident, n)) for n in (0, 12))
    assert all(each.rule in {one.rule for one in bound} for each in free)
    chosen = next(each for each in bound if each.rule == found.rule)
    assert chosen.effective_users >= 12
    assert chosen.value <= max(each.value for each in bound)
    best = max(bound, key=lambda each: each.value)
    assert best.effective_users < 12
    search = RuleSearch(problem(evident, 10**6))
    tried = search.simulate([each.rule for each in bound])
    assert not any(search.is_allowed(each) for each in tried)
    assert set(search.level(tried)) <= {*filter(search.is_supported, tried)}
    assert chosen.evidence is not None
    known = replace(chosen, evidence=replace(chosen.evidence, effective_users=1e6))
    assert search.level([*tried, known]) == [known]
    assert "too small to evaluate" in choose_by_simulation(problem(evident, 10**6))[0].warning


def test_the_card_has_the_estimate_of_the_rule_or_why_there_is_none(evident: Path) -> None:
    record = RunRecord.read(evident / "run")
    assert record.rule is not None
    estimate = record.rule.estimate
    assert estimate is not None
    for doubts in ((), ("it is too small",)):
        rule = record.rule.model_copy(update={"estimate": replace(estimate, doubts=doubts)})
        parts = describe_user_model(record.copy_with(rule=rule))
        value = f"{estimate.value:.4g} ± {estimate.error:.2g}"
        assert parts.get("estimated value") == (None if doubts else value)
        assert parts.get("value is not estimated, as") == (doubts[0] if doubts else None)

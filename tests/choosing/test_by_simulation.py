"""The decision rule is chosen on the log: finds what pays, keeps its conditions, says how."""

import copy
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.support.tagged import tagged_store
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.policy_actor import PolicyActor
from ucfrec.acting.rollout import rollout
from ucfrec.acting.scorer import Scorer
from ucfrec.choosing.by_ranking import choose_by_ranking
from ucfrec.choosing.by_simulation import RuleSearch, calibrate, choose_rule
from ucfrec.choosing.config import RuleConfig
from ucfrec.episodes.exposure import Likeness
from ucfrec.episodes.item_counts import TrainingCounts
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.atomic import read_json
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.logs.prepare import PrepareOptions, prepare
from ucfrec.policies.heads import ItemHead
from ucfrec.runs.config import config_from_dict, resolve_config
from ucfrec.runs.describe import describe_run, promised
from ucfrec.runs.refit import refit
from ucfrec.runs.run import train_run, training_views
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.user_model.reward import ItemRewardModel
from ucfrec.user_model.reward_fit import fit_item_reward_model
from ucfrec.user_model.reward_rows import RewardRows
from ucfrec.user_model.simulator import LoggedEnds, SessionEnd, UserSimulator
from ucfrec.user_model.training_users import TRAINING_USERS, fit_training_users

SMALL = ["train.steps=60", "train.learning_rate=3e-3", "train.warmup_steps=5", "policy.dim=16"]
SETTINGS = [*SMALL, "train.validate_every=20", "policy.context=6", "augment.copies=0"]
FEW = RuleConfig(sessions=40, reward_weights=(0.0, 4.0), least_impressions=1, least_items=2.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rule")
    store = tagged_store(folder)
    settings = [*SETTINGS, "rule.sessions=40", "rule.least_items=2.0"]
    train_run(store, folder / "run", resolve_config("ucf", None, settings))
    return folder


@pytest.fixture(scope="module")
def trained(folder: Path) -> TrainedPolicy:
    return TrainedPolicy.load(folder / "run")


def with_bias(
    trained: TrainedPolicy,
    bias: torch.Tensor,
    store: EpisodeStore | None = None,
    model: ItemRewardModel | None = None,
) -> Scorer:
    """A policy that shows items, (24,), by another bias; its run is not changed."""
    policy = copy.deepcopy(trained.policy)
    with torch.no_grad():
        assert isinstance(policy.head, ItemHead)
        policy.head.bias.copy_(bias)
    states = trained.item_states if store is None else store.item_states
    return Scorer(policy, DecisionRule(2.0), states, trained.returns, model or trained.reward_model)


def search_of(folder: Path, trained: TrainedPolicy, config: RuleConfig = FEW) -> RuleSearch:
    views = training_views(EpisodeStore.open(folder / "store"))
    return RuleSearch(trained.scorer(DecisionRule(2.0)), *views, config, seed=0)


def test_a_run_acts_by_the_rule_that_it_chose_and_says_how(
    folder: Path, trained: TrainedPolicy
) -> None:
    record = read_json(folder / "run" / "run.json")
    chosen = record["rule"]
    assert trained.rule == DecisionRule.from_dict(chosen["rule"], "the record")
    assert "validation" in chosen["chosen_by"]
    assert record["reward_model"]["loss"] < record["reward_model"]["base_loss"]
    best = max(chosen["candidates"], key=lambda each: each["value"])
    own = next(each for each in chosen["candidates"] if each["rule"] == chosen["rule"])
    assert own["value"] >= best["value"] - best["error"] or best["items"] < chosen["least_items"]
    assert promised(chosen) == (own["value"], own["error"])
    assert f"promised by it {own['value']:.4g} ±" in describe_run(record)
    assert promised({**chosen, "candidates": []}) is None


def test_a_reward_weight_pays_where_the_reward_model_knows_the_items(
    folder: Path, trained: TrainedPolicy
) -> None:
    search = search_of(folder, trained)
    plain, weighted = search.play(
        [
            DecisionRule(2.0, reward_weight=reward_weight, temperature=1.0)
            for reward_weight in (0, 4)
        ]
    )
    assert weighted.value > plain.value + 2 * plain.error
    assert weighted.items < plain.items


def test_playing_a_rule_twice_gives_the_same(folder: Path, trained: TrainedPolicy) -> None:
    rule = DecisionRule(2.0, reward_weight=1.0, temperature=0.5)
    assert search_of(folder, trained).play([rule]) == search_of(folder, trained).play([rule])


def test_rules_played_side_by_side_do_what_each_does_alone(
    folder: Path, trained: TrainedPolicy
) -> None:
    train, validation = training_views(EpisodeStore.open(folder / "store"))
    search = search_of(folder, trained)
    rules = [
        DecisionRule(2.0, temperature=1.0),
        DecisionRule(1.0, minimum_target=1.0, reward_weight=2.0, temperature=0.5),
        DecisionRule(3.0, tag_window=3),
        DecisionRule(3.0, reward_weight=4.0, tag_window=2, temperature=2.0),
    ]
    together = search.play(rules)
    model, n = trained.reward_model, FEW.sessions
    assert model is not None
    ends = LoggedEnds.of(train, model.lags, 100_000, 0)
    end = SessionEnd(Likeness.of(validation.item_states), ends)
    longest = int(train.lengths.max())
    environment = UserSimulator(validation, model, search.calibration, end, n, longest)
    users = np.arange(len(validation.item_states.user_features))
    for rule, candidate in zip(rules, together, strict=True):
        # A session a row, with sessions that begin anew and rows that are no longer live.
        scorer = trained.scorer(rule)
        actor = PolicyActor(
            *(scorer, n, validation.observation_size, validation.item_states, None, users), seed=0
        )
        alone = rollout(environment, actor, n, 0)  # type: ignore[arg-type]
        assert candidate.value == pytest.approx(float(alone.returns.mean()), abs=1e-9)
        assert candidate.length == pytest.approx(float(alone.lengths.mean()), abs=1e-9)
        assert candidate == search.play([rule])[0]


def test_unsupported_and_narrow_rules_are_not_allowed(folder: Path, trained: TrainedPolicy) -> None:
    search = search_of(folder, trained)
    (played,) = search.play([DecisionRule(2.0, temperature=1.0)])
    assert search.allowed(played)
    assert not search.allowed(replace(played, support=0.5))
    assert not search.allowed(replace(played, items=1.0))
    worse = replace(played, value=played.value - 10)
    better = replace(played, value=played.value + 10, items=1.0)
    assert search.best([better, worse, played]) == played
    # Within a standard error of the best, the first, which is the simplest.
    close = replace(played, value=played.value - played.error / 2)
    assert search.best([close, played]) == close
    # Or within the tolerance.
    sure = replace(played, error=0.0)
    assert search.best([replace(sure, value=0.985 * sure.value), sure]).value < sure.value
    assert search.best([replace(sure, value=0.975 * sure.value), sure]) == sure
    assert search.best([replace(played, items=1.0), replace(played, items=1.5)]).items == 1.5


def test_calibration_undoes_a_stretched_and_shifted_score(folder: Path) -> None:
    train, validation = training_views(EpisodeStore.open(folder / "store"))
    model, _ = fit_item_reward_model(train, validation, folder / "model", 0)
    rows = RewardRows.of(train, model.lags, 10_000, 0)
    slope, intercept = calibrate(model, rows)
    for name in ("item", "user", "state", "affinity", "interaction", "exposure"):
        model.get_buffer(name).mul_(2)
    model.item.add_(1)
    assert calibrate(model, rows)[0] == pytest.approx(slope / 2, rel=1e-3)
    assert calibrate(model, rows)[1] == pytest.approx(intercept - slope / 2, abs=1e-3)


def test_every_kind_of_candidate_is_played(folder: Path, trained: TrainedPolicy) -> None:
    views = training_views(EpisodeStore.open(folder / "store"))
    targets = {quantile: trained.target_return(quantile) for quantile in FEW.quantiles}
    found = choose_rule(trained.scorer(DecisionRule(2.0)), targets, *views, FEW, 0)
    rules = [candidate.rule for candidate in found.candidates]
    assert len(set(rules)) == len(rules)
    assert {rule.temperature for rule in rules} == set(FEW.temperatures)
    assert {rule.reward_weight for rule in rules} == set(FEW.reward_weights)
    together = {(rule.tag_window, rule.reward_weight) for rule in rules}
    assert together == set(product((0, 3, 10), FEW.reward_weights))
    assert {rule.minimum_target is None for rule in rules} == {True, False}


def test_what_the_log_supports_only_without_recent_tags_is_found(
    folder: Path, trained: TrainedPolicy
) -> None:
    train, validation = training_views(EpisodeStore.open(folder / "store"))
    # The best shows item 0 for ever, drawing shows items that the log hardly has; items 0 to 3
    # share no tag.
    narrow = with_bias(trained, torch.tensor([12.0, 10.0, 8.0, 6.0] + [0.0] * 20))
    config = replace(
        FEW,
        least_impressions=int(train.item_counts()[:4].min()),
        temperatures=(0.0, 4.0),
        reward_weights=(0.0,),
        tag_windows=(0, 3),
    )
    found = choose_rule(narrow, {0.9: 2.0, 1.0: 2.0}, train, validation, config, 0)
    assert found.supported
    assert found.rule == DecisionRule(2.0, temperature=0.0, tag_window=3)


def test_users_who_tire_are_shown_no_longer_runs(tmp_path: Path, trained: TrainedPolicy) -> None:
    store = tiring_store(tmp_path)
    train, validation = training_views(store)
    model, _ = fit_item_reward_model(train, validation, tmp_path / "model", 0)
    one_tag = torch.where(torch.arange(24) % 4 == 0, 9.0, 0.0)
    scorer = with_bias(trained, one_tag, store, model)
    config = replace(FEW, tag_windows=(0,), temperatures=(1.0,), reward_weights=(0.0,))
    found = choose_rule(scorer, {0.9: 2.0, 1.0: 3.0}, train, validation, config, 0)
    assert found.fatigue is not None
    assert (found.fatigue.length, found.fatigue.steps) == (3, 4)
    assert found.rule.tag_run == 2
    runs = {candidate.rule.tag_run for candidate in found.candidates}
    assert runs == set(FEW.tag_runs)
    none = replace(config, tag_runs=(0,))
    unlimited = choose_rule(scorer, {0.9: 2.0, 1.0: 3.0}, train, validation, none, 0)
    assert {candidate.rule.tag_run for candidate in unlimited.candidates} == {0}
    assert found.as_dict()["fatigue"]["length"] == 3


def test_the_most_promising_rules_are_played_in_more_sessions(
    folder: Path, trained: TrainedPolicy
) -> None:
    few = replace(FEW, sessions=10)
    search, more = (search_of(folder, trained, each) for each in (few, replace(few, sessions=40)))
    reward_weights = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)
    played = search.play(
        [
            DecisionRule(2.0, reward_weight=reward_weight, temperature=1.0)
            for reward_weight in reward_weights
        ]
    )
    allowed = [each for each in played if search.allowed(each)]
    worst = min(allowed, key=lambda each: each.value)
    again = search.play_finalists(played, worst)
    assert again[0].rule == worst.rule
    assert len(again) == min(8, len(allowed))
    highest = sorted((each.value for each in allowed), reverse=True)[: len(again) - 1]
    found = {each.rule for each in again[1:]}
    assert all(each.rule in found for each in allowed if each.value > highest[-1] and each != worst)
    assert again[1] == more.play([again[1].rule])[0]


def test_for_new_users_a_rule_is_tried_with_the_tastes_of_training_users(tmp_path: Path) -> None:
    one = ("temperatures=[1.0]", "reward weights=[0.0, 4.0]", "tag_windows=[0]", "tag_runs=[0]")
    rule = [
        f"rule.{each}" for each in (*one, "sessions=40", "least_items=2", "least_impressions=1")
    ]
    config = resolve_config("bc", None, [*SMALL, "train.validate_every=20", *rule])
    store = tiring_store(tmp_path)
    record = train_run(store, tmp_path / "run", config)
    assert record["reward_model"]["new_users"]
    assert "tastes of training users" in record["rule"]["chosen_by"]
    users = record["rule"]["users"]
    assert users["steps"] == users["effective_steps"] == record["train_steps"]
    assert list(users["calibration"]) == record["rule"]["calibration"]
    # Nothing that acts knows these tastes.
    trained = TrainedPolicy.load(tmp_path / "run")
    model = trained.reward_model
    assert model is not None
    assert not model.affinity.any()
    assert not model.user.any()
    # The chosen rule was played again in four times the sessions.
    views = training_views(store)
    tastes = fit_training_users(views[0], tmp_path / "run" / TRAINING_USERS, config.seed)
    scorer = trained.scorer(DecisionRule(2.0))
    more = RuleSearch(scorer, *views, replace(config.rule, sessions=160), config.seed, tastes)
    (played,) = more.play([trained.rule])
    assert promised(record["rule"]) == (played.value, played.error)


def test_of_rules_that_the_model_cannot_tell_apart_the_widest_draws_are_taken(
    tmp_path: Path, trained: TrainedPolicy
) -> None:
    store = tiring_store(tmp_path)
    train, validation = training_views(store)
    model, _ = fit_item_reward_model(train, validation, tmp_path / "model", 0)
    one_tag = torch.where(torch.arange(24) % 4 == 0, 9.0, 0.0)
    scorer = with_bias(trained, one_tag, store, model)
    config = replace(FEW, tag_windows=(0,), tolerance=0.1)
    found = choose_rule(scorer, {0.9: 2.0, 1.0: 3.0}, train, validation, config, 0)
    rule = found.rule
    assert rule.tag_run > 0
    same_run = [each for each in found.candidates if each.rule.tag_run == rule.tag_run]
    drawn = {(each.rule.temperature, each.rule.reward_weight) for each in same_run}
    assert drawn == set(product(config.temperatures, config.reward_weights))
    top = max(each.value for each in found.candidates)
    level = [each for each in same_run if each.value >= 0.9 * top and each.items >= 2]
    assert len({each.rule.temperature for each in level}) > 1
    assert rule.temperature == max(each.rule.temperature for each in level)


def tiring_store(folder: Path) -> EpisodeStore:
    """Sessions of users who like nothing for 4 steps after 3 likes of one tag on end."""
    rng, rows = np.random.default_rng(0), list[tuple[int, int, int, float]]()
    for user in range(160):
        tags, tired = list[int](), 0
        for step in range(40):
            item = int(rng.integers(24)) if rng.random() < 0.4 or not rows else rows[-1][1]
            liked = rng.random() < (0.02 if tired else 0.9)
            tags, tired = [*tags, item % 4 if liked else -1], max(0, tired - 1)
            if tags[-3:] == [item % 4] * 3:
                tired = 4
            minute = 28_000_000 + 40 * user + step
            rows.append((user, item, 60_000 * minute, float(liked)))
    log = pd.DataFrame(rows, columns=["user_id", "item_id", "timestamp", "reward"])
    log.to_parquet(folder / "log.parquet")
    items = pd.DataFrame({"item_id": range(24), "tags": [[f"t{item % 4}"] for item in range(24)]})
    items.to_parquet(folder / "items.parquet")
    users = pd.DataFrame({"user_id": range(160), "age": np.arange(160.0)})
    users.to_parquet(folder / "users.parquet")
    mapping = LogMapping(
        item_features=(FeatureTable((folder / "items.parquet",), "item_id"),),
        user_features=(FeatureTable((folder / "users.parquet",), "user_id"),),
    )
    options = PrepareOptions(reward="reward", session_by="gap", gap_minutes=120, embedding_size=6)
    prepare([folder / "log.parquet"], mapping, folder / "store", options)
    return EpisodeStore.open(folder / "store")


def test_reward_weights_below_the_first_that_overlaps_too_little_are_ranked_too(
    folder: Path, trained: TrainedPolicy
) -> None:
    views = training_views(EpisodeStore.open(folder / "store"))
    liked = TrainingCounts.of(views[0]).liked.topk(10).indices
    scorer = with_bias(trained, torch.zeros(24).index_fill(0, liked, 50.0))
    few = RuleConfig(reward_weights=(0.0, 1000.0))
    found = choose_by_ranking(scorer, *views, few, 0)
    reward_weights = [each.rule.reward_weight for each in found.candidates]
    assert reward_weights[:2] == [0.0, 1000.0]
    assert found.candidates[1].gain < 0
    assert found.supported
    overlapping = [each for each in found.candidates if each.gain >= 0]
    best = max(overlapping, key=lambda each: each.item_rate)
    assert found.rule == best.rule
    too_large = min(each.rule.reward_weight for each in found.candidates if each.gain < 0)
    assert too_large - max(each.rule.reward_weight for each in overlapping) == 1000 / 2 ** (
        len(reward_weights) - 2
    )


def test_a_rule_without_overlap_has_no_reward_weight_and_says_so(
    folder: Path, trained: TrainedPolicy
) -> None:
    views = training_views(EpisodeStore.open(folder / "store"))
    liked = TrainingCounts.of(views[0]).liked.topk(10).indices
    scorer = with_bias(trained, torch.zeros(24).index_fill(0, liked, -1e4))
    found = choose_by_ranking(scorer, *views, RuleConfig(reward_weights=(0.0, 1.0)), 0)
    assert not found.supported
    assert found.rule.reward_weight == 0
    assert "WARNING" in found.as_dict()["warning"]


def test_a_finished_run_that_is_trained_again_keeps_its_rule(
    folder: Path, trained: TrainedPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("the rule is chosen again")

    monkeypatch.setattr("ucfrec.runs.run.choose_rule", never)
    store = EpisodeStore.open(folder / "store")
    before = read_json(folder / "run" / "run.json")
    train_run(store, folder / "run", config_from_dict(before["config"]))
    after = read_json(folder / "run" / "run.json")
    assert after["rule"] == before["rule"]
    assert TrainedPolicy.load(folder / "run").rule == trained.rule


def test_a_refit_learns_from_all_rows_and_chooses_nothing_anew(
    folder: Path, trained: TrainedPolicy, tmp_path: Path
) -> None:
    store = EpisodeStore.open(folder / "store")
    record = refit(store, folder / "run", tmp_path / "refit")
    again = TrainedPolicy.load(tmp_path / "refit")
    assert record["train_steps"] == store.n_steps > trained.record["train_steps"]
    assert record["policy"]["steps"] == max(1, trained.record["policy"]["best_step"])
    assert "policy        trained on all rows, up to step" in describe_run(record)
    assert again.rule == trained.rule
    assert again.reward_model is not None
    assert trained.reward_model is not None
    assert not torch.equal(again.reward_model.item, trained.reward_model.item)
    assert again.counts is not None
    assert int(again.counts.shown.sum()) == store.n_steps
    assert np.isfinite(again.training_returns).all()

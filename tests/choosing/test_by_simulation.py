"""The decision rule is chosen on the log: finds what pays, keeps its conditions, says how."""

import copy
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.support.logs import store_of
from tests.support.tagged import tagged_store
from ucfrec import Recommender
from ucfrec.acting.decision import DecisionRule
from ucfrec.acting.scorer import Scorer
from ucfrec.arrays import Array, IntArray
from ucfrec.choosing.by_simulation import (
    LoggedGains,
    Outcomes,
    RuleSearch,
    _correct,
    _warning,
    choose_by_simulation,
    find_neighbours,
)
from ucfrec.choosing.choice import Problem, RuleChoice, RuleConfig, RuleEvidence
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.atomic import read_json
from ucfrec.logs.mapping import FeatureTable, LogMapping
from ucfrec.policies.heads import ItemHead
from ucfrec.runs.config import config_from_dict, resolve_config
from ucfrec.runs.record import read_record
from ucfrec.runs.run import train_run
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import REWARD_MODEL, TrainedPolicy
from ucfrec.user_model.model import UserModel

SMALL = ["train.steps=60", "train.learning_rate=3e-3", "train.warmup_steps=5", "policy.dim=16"]
SETTINGS = [*SMALL, "train.validate_every=20", "policy.context=6", "augment.copies=0"]
ONE_TAG = torch.where(torch.arange(24) % 4 == 0, 9.0, 0.0)
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


def with_bias(trained: TrainedPolicy, bias: torch.Tensor) -> Scorer:
    """A policy that shows items, (24,), by another bias; its run is not changed."""
    policy = copy.deepcopy(trained.policy)
    with torch.no_grad():
        assert isinstance(policy.head, ItemHead)
        policy.head.bias.copy_(bias)
    return replace(trained, policy=policy).scorer(DecisionRule(2.0))


def users_of(run: Path, store: EpisodeStore) -> UserModel:
    """The user model of a run, or one that is fitted in its folder."""
    return UserModel.fit(*training_views(store), run / REWARD_MODEL, 0)


def search_of(trained: TrainedPolicy, config: RuleConfig = FEW) -> RuleSearch:
    store = EpisodeStore.open(trained.folder.parent / "store")
    users, scorer = users_of(trained.folder, store), trained.scorer(DecisionRule(2.0))
    return RuleSearch(Problem(scorer, users, {}, *training_views(store), config, 0))


def drawn(weight: float) -> DecisionRule:
    """At temperature 1, with a reward weight."""
    return DecisionRule(2.0, reward_weight=weight, temperature=1.0)


def chosen(
    scorer: Scorer, store: EpisodeStore, run: Path, config: RuleConfig, *targets: float
) -> RuleChoice:
    users = users_of(run, store)
    parts = store.item_states, scorer.returns, users.reward, users.session_end
    scorer = Scorer(scorer.policy, scorer.rule, *parts)
    given = dict(zip((0.9, 1.0), targets, strict=True))
    return choose_by_simulation(Problem(scorer, users, given, *training_views(store), config, 0))


def test_a_run_acts_by_the_rule_that_it_chose_and_says_how(trained: TrainedPolicy) -> None:
    record, found = read_json(trained.folder / "run.json"), read_record(trained.folder)
    rule = record["rule"]
    assert trained.rule == DecisionRule.from_dict(rule["rule"], "the record")
    assert record["reward_model"]["loss"] < record["reward_model"]["base_loss"]
    candidates = read_json(trained.folder / "candidates.json")
    best = max(candidates, key=lambda each: each["value"])
    own = next(each for each in candidates if each["rule"] == rule["rule"])
    assert own["value"] >= best["value"] - best["error"] or best["items"] < 2
    assert found.rule is not None
    estimate = found.rule.estimate
    assert estimate is not None
    assert estimate.value == pytest.approx(sum(estimate.halves) / 2)
    assert estimate.error >= abs(estimate.halves[0] - estimate.halves[1]) / 2
    text, value = found.describe(), f"session: {estimate.value:.4g} ± {estimate.error:.2g}"
    assert "Its return is not estimated: the log has rows without propensities" in text
    assert value not in text
    trusted = found.rule.model_copy(update={"estimate": replace(estimate, doubts=())})
    assert value in found.copy_with(rule=trusted).describe()


def test_rules_side_by_side_do_what_each_does_alone(trained: TrainedPolicy) -> None:
    search = search_of(trained, replace(FEW, sessions=30))
    rules = [
        DecisionRule(2.0, temperature=1.0),
        DecisionRule(1.0, minimum_target=1.0, reward_weight=2.0, temperature=0.5),
        DecisionRule(3.0, tag_window=3),
        DecisionRule(3.0, reward_weight=4.0, tag_window=2, temperature=2.0),
    ]
    assert search.simulate(rules) == [search.simulate([rule])[0] for rule in rules]


def test_unsupported_and_narrow_rules_are_not_allowed(trained: TrainedPolicy) -> None:
    search = search_of(trained)
    (simulated,) = search.simulate([drawn(0.0)])
    assert search.is_allowed(simulated)
    assert not search.is_allowed(replace(simulated, support=0.5))
    assert not search.is_allowed(replace(simulated, items=1.0))
    worse = replace(simulated, value=simulated.value - 10)
    better = replace(simulated, value=simulated.value + 10, items=1.0)
    assert search.best([better, worse, simulated]) == simulated
    # Within a standard error of the best, the first, which is the simplest.
    close = replace(simulated, value=simulated.value - simulated.error / 2)
    assert search.best([close, simulated]) == close
    # Or within the tolerance.
    sure = replace(simulated, error=0.0)
    assert search.best([replace(sure, value=0.985 * sure.value), sure]).value < sure.value
    assert search.best([replace(sure, value=0.975 * sure.value), sure]) == sure
    assert search.best([replace(simulated, items=1.0), replace(simulated, items=1.5)]).items == 1.5


def test_rules_are_told_apart_by_the_same_sessions(trained: TrainedPolicy) -> None:
    search, rules = search_of(trained), [DecisionRule(2.0), drawn(0.0)]
    found = search.simulate(rules)
    luck, nothing = np.random.default_rng(0).normal(50.0, 20.0, 40), np.zeros(0, dtype=np.int64)
    for rule, more in zip(rules, (0.0, 3.0), strict=True):
        search._sessions[rule] = Outcomes(luck + more, nothing, nothing, luck)
    low, high = replace(found[0], value=luck.mean()), replace(found[1], value=luck.mean() + 3.0)
    assert search.level([low, high]) == [high]
    search._sessions[low.rule] = Outcomes(np.roll(luck, 1), nothing, nothing, luck)
    assert search.level([low, high]) == [low, high]
    # Of these, the simplest: the higher temperature, whatever comes first.
    assert search.best([low, high]) == search.best([high, low]) == high
    # Or the one that the log says most of: by effective users, then the hits.
    known = replace(low, evidence=RuleEvidence(0.1, 20.0))
    unknown, hitting = (replace(high, evidence=RuleEvidence(0.3, n)) for n in (9.0, 20.0))
    assert search.most_evident([unknown, known]) == known
    assert search.most_evident([known, hitting]) == hitting
    # Or what it says of their values, less their errors, if it can evaluate both.
    low, high = (
        replace(rule, evidence=RuleEvidence(0.1, users, 0.0, value, 0.2))
        for rule, users, value in ((low, 300.0, 1.5), (high, 900.0, 1.4))
    )
    assert search.most_evident([low, high]) == high
    search.least_users = 200.0
    assert search.most_evident([low, high]) == low


def test_rules_far_behind_are_not_simulated_in_all_sessions(trained: TrainedPolicy) -> None:
    search = search_of(trained, replace(FEW, sessions=120))
    plain, close, best = (drawn(weight) for weight in (0.0, 3.8, 4.0))
    found = dict(zip((plain, close, best), search.simulate([plain, close, best]), strict=True))
    returns = {rule: sessions.returns for rule, sessions in search._sessions.items()}
    assert [len(returns[rule]) for rule in found] == [30, 120, 120]
    ahead = max(close, best, key=lambda rule: float(returns[rule][:30].mean()))
    behind = float((returns[ahead][:30] - returns[plain]).mean())
    assert found[ahead].value == pytest.approx(returns[ahead].mean())
    assert found[plain].value == pytest.approx(found[ahead].value - behind)
    assert found[plain].error > found[ahead].error
    # The first sessions are those of a search that has no others.
    few = search_of(trained, replace(FEW, sessions=30))
    few.simulate([plain, best])
    for rule in (plain, best):
        np.testing.assert_array_equal(returns[rule][:30], few._sessions[rule].returns)
    # A rule that the log does not support rules nothing out.
    unsupported = search_of(trained, replace(FEW, sessions=120))
    unsupported.least_items = 1e9
    unsupported.simulate([plain, best])
    assert {len(each.returns) for each in unsupported._sessions.values()} == {120}


def test_every_kind_of_candidate_is_simulated(folder: Path, trained: TrainedPolicy) -> None:
    targets = (trained.target_return(quantile) for quantile in FEW.quantiles)
    store, scorer = EpisodeStore.open(folder / "store"), trained.scorer(DecisionRule(2.0))
    _, candidates = chosen(scorer, store, folder / "run", FEW, *targets)
    rules = [candidate.rule for candidate in candidates]
    assert len(set(rules)) == len(rules)
    assert {rule.temperature for rule in rules} == set(FEW.temperatures)
    assert {rule.reward_weight for rule in rules} == set(FEW.reward_weights)
    together = {(rule.tag_window, rule.reward_weight) for rule in rules}
    assert together == set(product((0, 3, 10), FEW.reward_weights))
    assert {rule.minimum_target is None for rule in rules} == {True, False}


def test_what_the_log_supports_only_without_recent_tags_is_found(trained: TrainedPolicy) -> None:
    store = EpisodeStore.open(trained.folder.parent / "store")
    # The best shows item 0 for ever, drawing shows items that the log hardly has; items 0 to 3
    # share no tag.
    narrow = with_bias(trained, torch.tensor([12.0, 10.0, 8.0, 6.0] + [0.0] * 20))
    least = int(training_views(store)[0].item_counts()[:4].min())
    tried = {"temperatures": (0.0, 4.0), "reward_weights": (0.0,), "tag_windows": (0, 3)}
    config = replace(FEW, least_impressions=least, **tried)
    found, _ = chosen(narrow, store, trained.folder, config, 2.0, 2.0)
    assert not found.warning
    assert found.rule == DecisionRule(2.0, temperature=0.0, tag_window=3)


def test_a_policy_below_the_log_is_warned_of(trained: TrainedPolicy) -> None:
    search, rule = search_of(trained), drawn(0.0)
    (found,), estimate = search.simulate([rule]), search.estimate(rule)
    logged = float(search.problem.train.returns.mean())
    for value, below in ((logged - 0.5, True), (logged - 0.1, False), (logged + 1, False)):
        warning = _warning(search, found, replace(estimate, value=value, error=0.1))
        assert (f"logged sessions have {logged:.4g}, which is more" in warning) == below


def test_estimates_are_corrected_by_logged_steps_of_like_expected_reward() -> None:
    rng, nothing = np.random.default_rng(0), np.zeros(0, dtype=np.int64)
    simulated = Outcomes(np.zeros(50), nothing, nothing, rng.uniform(0.6, 0.9, 250))
    results = []
    for _ in range(100):
        # Of what is promising, half of the logged steps have less; the log rarely shows these.
        expected, poor = rng.random(4000), rng.random(4000) < 0.5
        gains, weights = np.where((expected > 0.5) & poor, -0.2, 0.0), np.where(poor, 4.0, 1.0)
        results.append(_correct(simulated, LoggedGains(expected, gains, weights)))
    values, errors, steps = np.transpose(results)
    assert values.mean() == pytest.approx(5 * -0.2 * 0.8, abs=0.005)
    assert errors.mean() == pytest.approx(values.std(), rel=0.2)
    assert ((steps > 0.6 * 1200) & (steps < 1200)).all()
    # What gains the less the more it promises does so beyond what was logged, with fewer steps.
    counts = []
    for most in (1.0, 0.7):
        low = expected[expected < most]
        falling = LoggedGains(low, 0.1 - low, np.zeros(len(low)))
        gain, error, n = _correct(simulated, falling, weighted=False)
        assert gain == pytest.approx(5 * (0.1 - simulated.expected.mean()))
        assert error == pytest.approx(0, abs=1e-9)
        counts.append(n)
    assert counts[1] < 50 < 500 < counts[0]
    # Nothing that the log shows promises as much.
    low = expected[expected < 0.5]
    assert _correct(simulated, LoggedGains(low, low, low)) == (0.0, 0.0, 0.0)


@pytest.mark.slow
def test_users_who_tire_are_shown_no_longer_runs(tmp_path: Path, trained: TrainedPolicy) -> None:
    store, scorer = tiring_store(tmp_path), with_bias(trained, ONE_TAG)
    one = {"temperatures": (1.0,), "reward_weights": (0.0,)}
    config = replace(FEW, tag_windows=(0,), lookaheads=(0.0,), **one)
    found, candidates = chosen(scorer, store, tmp_path, config, 2.0, 3.0)
    fatigue = users_of(tmp_path, store).fatigue
    assert (fatigue.length, fatigue.steps) == (3, 4)
    assert found.rule.tag_run == 2
    _, unlimited = chosen(scorer, store, tmp_path, replace(config, tag_runs=(0,)), 2.0, 3.0)
    for tried, runs in ((candidates, FEW.tag_runs), (unlimited, (0,))):
        assert {candidate.rule.tag_run for candidate in tried} == {*runs}


def test_rules_of_the_highest_value_are_simulated_in_more_sessions(trained: TrainedPolicy) -> None:
    search, more = (search_of(trained, replace(FEW, sessions=sessions)) for sessions in (10, 40))
    simulated = search.simulate([drawn(weight) for weight in (0, 0.5, 1, 2, 3, 4, 5, 6, 7, 8)])
    allowed = [each for each in simulated if search.is_allowed(each)]
    best, again = search.best(simulated), search.finalists(simulated)
    assert again[0].rule == best.rule
    assert len(again) == min(8, len(allowed))
    others, found = [each for each in allowed if each != best], {each.rule for each in again[1:]}
    least = sorted((each.value for each in others), reverse=True)[len(found) - 1]
    assert all(each.rule in found for each in others if each.value > least)
    assert again[1] == more.simulate([again[1].rule])[0]


def test_for_new_users_a_rule_is_tried_with_the_tastes_of_training_users(tmp_path: Path) -> None:
    one = "temperatures=[1.0] reward_weights=[0.0,4.0] tag_windows=[0] tag_runs=[0] quantiles=[1.0]"
    rule = f"{one} lookaheads=[0.0] sessions=15 least_items=2 least_impressions=1".split()
    settings = [*SMALL, "train.validate_every=20", *(f"rule.{each}" for each in rule)]
    config = resolve_config("bc", None, settings)
    store = tiring_store(tmp_path)
    record = train_run(store, tmp_path / "run", config)
    assert record.reward_model is not None
    assert record.rule is not None
    assert record.reward_model.new_users
    assert any("new" in doubt for doubt in record.rule.estimate.doubts)
    # Nothing that acts knows these tastes.
    trained = TrainedPolicy.load(tmp_path / "run")
    model = trained.reward_model
    assert model is not None
    assert not model.affinity.any()
    assert not model.user.any()
    users = users_of(tmp_path / "run", store)
    assert users.training_users[1].calibration == users.calibration
    # The chosen rule was simulated again in four times the sessions.
    more = search_of(trained, replace(config.rule, sessions=60))
    (simulated,) = more.simulate([trained.rule])
    tried = read_json(trained.folder / "candidates.json")
    (own,) = (entry for entry in tried if entry["rule"] == trained.rule.as_dict())
    assert (own["value"], own["error"]) == (simulated.value, simulated.error)


def test_a_choice_that_starts_from_a_rule_tries_its_neighbours_only(trained: TrainedPolicy) -> None:
    store = EpisodeStore.open(trained.folder.parent / "store")
    users, views = users_of(trained.folder, store), training_views(store)
    scorer = Scorer(
        trained.policy, trained.rule, store.item_states, trained.record.return_to_go, users.reward
    )
    config = replace(FEW, reward_weights=(0.0, 1.0, 4.0, 8.0), tag_windows=(3, 5))
    given = Problem(scorer, users, {0.9: 2.0, 1.0: 3.0}, *views, config, 0)
    bad = DecisionRule(2.0, reward_weight=1.0, temperature=1.0)
    found, candidates = choose_by_simulation(replace(given, start=bad))
    rules = [each.rule for each in candidates]
    assert rules[0] == bad
    assert len({*rules}) == len(rules)
    plain = [each for each in rules if not each.lookahead]
    assert {each.temperature for each in plain} == {0.5, 1.0}
    assert {each.reward_weight for each in plain} == {0.0, 1.0, 4.0}
    assert {each.target for each in plain} == {2.0, 3.0}
    assert {each.tag_window for each in plain} == {0, 3}
    value = {each.rule: each.value for each in candidates}
    assert value[found.rule] > value[bad]
    assert "near that of an earlier run" in found.chosen_by
    # From there it moves on as long as a neighbour is better, and then stays.
    moves = [found.rule]
    while len({*moves}) == len(moves):
        moves.append(choose_by_simulation(replace(given, start=moves[-1]))[0].rule)
    assert moves[-1] == moves[-2]
    # Where the log supports none, it stays: nothing says that a neighbour is better.
    unsupported = replace(config, least_impressions=10_000)
    stays, _ = choose_by_simulation(replace(given, start=bad, config=unsupported))
    assert stays.rule == bad
    assert "supports no candidate, so the rule of the earlier run stays" in stays.warning
    train = views[0]
    mean = float(train.returns.sum(dtype=np.float64)) / train.n_steps
    ahead = replace(bad, lookahead=4.0 * mean, policy_weight=0.5, reward_weight=8.0)
    rules = [*find_neighbours(ahead, given)]
    assert {each.reward_weight for each in rules if each.lookahead} == {8.0, 32.0}
    assert {each.policy_weight for each in rules if each.lookahead} == {0.0, 0.5, 1.0}
    assert sum(not each.lookahead for each in rules) == 1


def listed_store(folder: Path) -> tuple[EpisodeStore, Callable[..., Array]]:
    """Pages of four random items, worth less below one of their tag; chances of clicks (B, 4)."""
    rng, n_items, sessions, pages = np.random.default_rng(0), 36, 600, 3
    quality, taste = rng.normal(0, 0.6, n_items), rng.normal(0, 1.2, (60, 4))

    def chances(users: IntArray, items: IntArray) -> Array:
        tags = items % 4
        above = np.tril(tags[:, :, None] == tags[:, None], -1).sum(2)
        odds = quality[items] + taste[users[:, None], tags] - 2 * above - 0.2 * np.arange(4)
        return np.asarray(1 / (1 + np.exp(1 - odds)))

    items = rng.permuted(np.tile(np.arange(n_items), (sessions, 1)), axis=1)[:, : 4 * pages]
    items, users = items.reshape(-1, 4), np.repeat(np.arange(sessions) % 60, pages)
    times = 10**12 + 10**7 * np.arange(sessions)[:, None] + 60_000 * np.arange(pages)
    clicks = rng.random(items.shape) < chances(users, items)
    columns = {"user_id": users, "timestamp": times.ravel(), "request_id": np.arange(len(users))}
    log = pd.DataFrame({name: values.repeat(4) for name, values in columns.items()})
    position = np.tile(np.arange(4), len(users))
    log = log.assign(item_id=items.ravel(), position=position, reward=clicks.ravel() * 1.0)
    tags = pd.DataFrame(
        {"item_id": range(n_items), "tags": [[f"t{n % 4}"] for n in range(n_items)]}
    )
    tags.to_parquet(folder / "items.parquet")
    mapping = LogMapping(item_features=(FeatureTable((folder / "items.parquet",), "item_id"),))
    options = {"reward": "reward", "session_by": "gap", "gap_minutes": 60}
    return store_of(log, folder, mapping, **options), chances


def test_lists_are_built_by_marginal_gain_where_that_pays(tmp_path: Path) -> None:
    store, chances = listed_store(tmp_path)
    smaller = ["train.steps=20", "rule.sessions=60", "rule.tag_windows=[0]", "rule.lookaheads=[0]"]
    smaller += ["rule.quantiles=[1.0]", "rule.temperatures=[0.0]", "rule.reward_weights=[0,2,4]"]
    policy = Recommender("bc", settings=[*SETTINGS, *smaller]).fit(store, tmp_path / "run")
    rule, model = policy.trained.rule, policy.trained.reward_model
    assert rule.by_marginal_gain
    assert model is not None
    assert float(model.above) < -0.5
    log, clicks = pd.read_parquet(tmp_path / "log.parquet"), {}
    for by_gain in (True, False):
        lists = policy.recommend(
            log, 4, rule=replace(rule, by_marginal_gain=by_gain), filter_seen=False
        )
        users, items = (lists[name].to_numpy().reshape(-1, 4) for name in ("user_id", "item_id"))
        clicks[by_gain] = float(chances(users[:, 0], items).sum(1).mean())
    assert clicks[True] > 1.1 * clicks[False]
    scorer, users_model = policy.trained.scorer(rule), users_of(tmp_path / "run", store)
    problem = Problem(scorer, users_model, {}, *training_views(store), FEW, 0)
    assert replace(rule, by_marginal_gain=False) in [*find_neighbours(rule, problem)]


def tiring_store(folder: Path) -> EpisodeStore:
    """Sessions of users who like nothing for 4 steps after 3 likes of one tag in a row."""
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
    items = pd.DataFrame({"item_id": range(24), "tags": [[f"t{item % 4}"] for item in range(24)]})
    items.to_parquet(folder / "items.parquet")
    users = pd.DataFrame({"user_id": range(160), "age": np.arange(160.0)})
    users.to_parquet(folder / "users.parquet")
    tables = [FeatureTable((folder / f"{of}s.parquet",), f"{of}_id") for of in ("item", "user")]
    mapping = LogMapping(item_features=(tables[0],), user_features=(tables[1],))
    options = {"reward": "reward", "session_by": "gap", "gap_minutes": 120, "embedding_size": 6}
    return store_of(log, folder, mapping, **options)


def test_a_finished_run_that_is_trained_again_keeps_its_rule(
    trained: TrainedPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("ucfrec.runs.run.choose_by_simulation")
    run = trained.folder
    before = read_json(run / "run.json")
    store = EpisodeStore.open(run.parent / "store")
    train_run(store, run, config_from_dict(before["config"]))
    assert read_json(run / "run.json")["rule"] == before["rule"]
    assert TrainedPolicy.load(run).rule == trained.rule

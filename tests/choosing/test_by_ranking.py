"""The reward weight chosen by ranking is evaluated by what each rule would have shown."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.logs import store_of
from tests.support.tagged import tagged_log, tagged_mapping
from ucfrec.acting.scorer import logged_scores
from ucfrec.choosing.by_ranking import choose_by_ranking
from ucfrec.choosing.choice import Problem, RankedRule, RuleChoice, RuleConfig
from ucfrec.choosing.logged import SHOWN
from ucfrec.episodes.states import TrainingCounts, liked_rewards
from ucfrec.episodes.store import EpisodeStore
from ucfrec.files.atomic import read_json
from ucfrec.policies.heads import ItemHead
from ucfrec.runs.config import resolve_config
from ucfrec.runs.run import train_run
from ucfrec.runs.start import training_views
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec.user_model.model import UserModel

SETTINGS = ["train.steps=5", "policy.dim=16", "policy.context=4", "augment.copies=0"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ranking")
    store = store_of(
        tagged_log(),
        folder,
        tagged_mapping(folder),
        reward="reward",
        session_by="user",
        embedding_size=6,
    )
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
    config = RuleConfig(reward_weights=weights)
    scorer, users = (
        replace(trained, policy=policy).scorer(),
        UserModel.fit(*views, folder / "um", 0),
    )
    return choose_by_ranking(Problem(scorer, users, {}, *views, config, 0))


def test_all_reward_weights_at_once_are_evaluated_as_each_rule_alone(folder: Path) -> None:
    trained = TrainedPolicy.load(folder / "run")
    _, validation = training_views(EpisodeStore.open(folder / "store"))
    episodes, steps = validation.all_steps()
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


def test_reward_weights_below_the_first_that_overlaps_too_little_are_ranked_too(
    folder: Path,
) -> None:
    found = chosen(folder, 50.0, 0.0, 1000.0)
    ranked = [each for each in found.candidates if isinstance(each, RankedRule)]
    weights = [each.rule.reward_weight for each in ranked]
    assert weights[:2] == [0.0, 1000.0]
    assert ranked[1].gain < ranked[1].gain_error
    assert not found.warning
    overlapping = [each for each in ranked if each.gain >= each.gain_error]
    assert found.rule in [each.rule for each in overlapping]
    too_large = min(each.rule.reward_weight for each in ranked if each.gain < each.gain_error)
    largest = max(each.rule.reward_weight for each in overlapping)
    assert too_large - largest == 1000 / 2 ** (len(weights) - 2)


def test_without_overlap_a_rule_hits_as_often_as_any_and_says_so(folder: Path) -> None:
    found = chosen(folder, -1e4, 0.0, 1.0)
    ranked = [each for each in found.candidates if isinstance(each, RankedRule)]
    assert not any(each.gain >= each.gain_error for each in ranked)
    most = max(ranked, key=lambda each: each.gain)
    level = [each for each in ranked if each.gain >= most.gain - most.gain_error]
    assert found.rule in [each.rule for each in level]
    assert "WARNING" in found.warning

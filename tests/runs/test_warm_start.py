"""A warm training begins with the old weights; rows of new items begin as in a new policy."""

from pathlib import Path

import torch

from tests.support.later import later_log, later_mapping
from tests.support.served import trained_run
from tests.support.tagged import ITEMS
from ucfrec.episodes.store import EpisodeStore
from ucfrec.logs.append import append_logs
from ucfrec.runs.config import resolve_config
from ucfrec.runs.start import new_policy
from ucfrec.runs.warm_start import start_warm, warm_settings


def test_what_the_old_run_knows_is_kept(tmp_path: Path) -> None:
    trained = trained_run(tmp_path)
    later_log().to_parquet(tmp_path / "later.parquet")
    logs, mapping = [tmp_path / "later.parquet"], later_mapping(tmp_path)
    append_logs(tmp_path / "store", logs, tmp_path / "grown", mapping)
    store = EpisodeStore.open(tmp_path / "grown").split("train")
    policy = new_policy(store, trained.record.config)
    fresh = {name: value.clone() for name, value in policy.state_dict().items()}
    start_warm(policy, tmp_path / "run2", tmp_path / "run")
    old = trained.policy.state_dict()
    for name, value in policy.named_parameters():
        known = len(old[name]) if value.dim() else None
        assert torch.equal(value[:known] if value.dim() else value, old[name]), name
        if value.dim() and len(value) > len(old[name]):
            assert torch.equal(value[known:], fresh[name][known:])
    assert torch.equal(policy.state_mean, trained.policy.state_mean)
    counts = policy.state_dict()["head.counts"]
    assert len(counts) > ITEMS
    assert torch.equal(counts, fresh["head.counts"])


def test_warm_settings_are_a_share_of_the_whole() -> None:
    config = resolve_config("ucf", None, ["train.steps=800"])
    warm = warm_settings(config)
    assert warm.train.steps == 50
    assert warm.train.warmup_steps == 5
    assert warm.train.validate_every == 50
    assert warm.crm.epochs == 1
    assert warm.policy == config.policy
    assert warm_settings(config, 1.0).train.steps == 800

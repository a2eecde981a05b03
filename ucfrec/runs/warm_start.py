"""Begin a training with the weights of a run on an older state of the store."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Final

import torch

from ucfrec.acting.decision import DecisionRule
from ucfrec.counterfactual.augmentation import CRM
from ucfrec.counterfactual.reward_model import INITIAL
from ucfrec.files.atomic import atomic_file
from ucfrec.fitting.checkpoint import load_trained
from ucfrec.policies.base import SequencePolicy
from ucfrec.runs.config import Config
from ucfrec.runs.record import REFIT, RunRecord, read_record, refit_of_run
from ucfrec.runs.trained_policy import TrainedPolicy

SHARE: Final = 1 / 16
"""Steps of a warm training, as a share of those of one from scratch."""
_SCALES: Final = ("state_mean", "state_std", "return_scale", "lowest_return_to_go")
"""Buffers of a policy that its weights were trained with."""
_CRM_EPOCHS: Final = 5
"""Epochs that `crm.epochs` 0 stands for."""


@torch.no_grad()
def start_warm(policy: SequencePolicy, out: Path, initial: Path) -> None:
    """Give a policy, and the reward model of its augmentation, the weights of another run.

    Rows of users and items that the other run does not know keep what the new policy begins with:
    for items no correction of their vector, and the log of their share of the training steps.

    Args:
        out: folder of the new run, which receives the reward model's weights.
    """
    acting = initial if refit_of_run(initial, read_record(initial)) is None else initial / REFIT
    path = acting / "policy" / "best.safetensors"
    trained, names = load_trained(path), {name for name, _ in policy.named_parameters()}
    state = policy.state_dict()
    for name in sorted(state.keys() & trained.keys()):
        new, old = state[name], trained[name]
        if name not in names and name not in _SCALES:
            continue
        if new.shape == old.shape:
            new.copy_(old)
        elif new.shape[1:] == old.shape[1:] and len(new) > len(old):
            new[: len(old)] = old
    best, target = initial / CRM / "cvae" / "best.safetensors", out / CRM / INITIAL
    if best.exists() and not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(target) as scratch:
            shutil.copyfile(best, scratch)


def rule_to_start_from(initial: Path, new: TrainedPolicy) -> DecisionRule:
    """The rule of a run, in the units of another: targets are the same quantile of the training
    returns, and the lookahead the same number of mean rewards."""
    old = TrainedPolicy.load(initial, split=True)
    rule, quantiles = old.rule, new.record.config.rule.quantiles
    if rule.target is not None:
        target = rule.target
        nearest = min(quantiles, key=lambda quantile: abs(old.target_return(quantile) - target))
        moved = new.target_return(nearest)
        least = None if rule.minimum_target is None else moved
        rule = replace(rule, target=moved, minimum_target=least)
    of_new, of_old = (_mean_reward(trained.record) for trained in (new, old))
    return replace(rule, lookahead=rule.lookahead * of_new / of_old if of_old > 0 else 0.0)


def _mean_reward(record: RunRecord) -> float:
    return record.mean_return * record.train_episodes / record.train_steps


def warm_settings(config: Config, share: float = SHARE) -> Config:
    """The settings of a warm training.

    Args:
        share: of the steps and epochs of a training from scratch.
    """
    steps = max(1, round(share * config.train.steps))
    train = replace(
        config.train,
        steps=steps,
        warmup_steps=min(config.train.warmup_steps, steps // 10),
        validate_every=min(config.train.validate_every, steps),
    )
    epochs = max(1, round(share * (config.crm.epochs or _CRM_EPOCHS)))
    return replace(config, train=train, crm=replace(config.crm, epochs=epochs))

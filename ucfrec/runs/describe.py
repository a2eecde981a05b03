"""What a finished run did, in a few lines."""

import math
from collections.abc import Container, Mapping
from typing import Any

from ucfrec.acting.decision import DecisionRule
from ucfrec.runs.reference_losses import learned_nothing
from ucfrec.runs.trained_policy import REFIT_OF


def describe_run(record: Mapping[str, Any], logged: Container[str] = ()) -> str:
    """Summary of a finished run, a few lines of text.

    Args:
        record: of the run.
        logged: names of the scalars that its training logged; see `learned_nothing`.
    """
    lines = []
    if "augmentation" in record:
        report = record["augmentation"]
        crm, moves = report["reward_model"], report["moves"]
        lines += [
            f"reward model  R² {_text(crm['r2'], '.3f')} with z, "
            f"{_text(crm['r2_without_z'], '.3f')} without; "
            f"{crm['active_dimensions']} of {crm['latent_dim']} latent dimensions active",
        ]
        if report["proposals"]:
            lines.append(
                f"edits         {report['copies']} copies, acceptance {report['acceptance']:.1%}, "
                f"mean-move ratio {_text(moves['mean_move_ratio'], '.2f')}, effective rank "
                f"{moves['effective_rank']:.1f} of {moves['dimensions']}"
            )
        if (actions := report.get("actions")) is not None:
            lines.append(
                f"other actions {actions['copies']:,} copies of {actions['proposals']:,} asked "
                f"about; their reward differs by "
                f"{_text(actions['mean_change'], '+.3g')} on average, "
                f"{_text(actions['earns_more'], '.0%')} of them earn more"
            )
        lines.append(
            f"bound         δ + ε_r = {report['delta']:.3g} + {report['epsilon_r']:.3g}: "
            f"{report['verdict']}"
        )
        lines += [f"warning       {warning}" for warning in report["warnings"]]
    policy = record["policy"]
    best = _text(policy["best_validation"], ".4g")
    found = f"best validation loss {best} at step {policy['best_step']}"
    if REFIT_OF in record:
        found = f"trained on all rows, up to step {policy['best_step']}"
    lines.append(f"policy        {found} of {policy['steps']}, {policy['seconds']:.0f} s")
    if warning := learned_nothing(record, logged):
        lines.append(f"warning       {warning}")
    if "rule" in record:
        lines.append(_describe_rule(record["rule"], record["reward_model"]))
    return "\n".join(lines)


def _text(value: float | None, form: str) -> str:
    """A number of a record as text; a dash where JSON had to hold null, as for NaN."""
    return "–" if value is None or not math.isfinite(value) else f"{value:{form}}"


def _describe_rule(choice: Mapping[str, Any], model: Mapping[str, Any]) -> str:
    rule = DecisionRule.from_dict(choice["rule"], "the run's record")
    gain = model["item_loss"] - model["loss"]
    value = promised(choice)
    told = "" if value is None else f"; return promised by it {value[0]:.4g} ± {value[1]:.2g}"
    return (
        f"items         reward model: held-out loss {model['loss']:.4f}, {gain:.4f} below that of "
        f"item effects alone\n"
        f"decision rule {rule}\n"
        f"              chosen by {choice['chosen_by']}{told}{choice.get('warning', '')}"
    )


def promised(choice: Mapping[str, Any]) -> tuple[float, float] | None:
    """The return that the model of the users promised of the chosen rule, and its standard error.

    Args:
        choice: `rule` of a run's record; None for a rule that was not played in such a model.
    """
    for tried in choice.get("candidates", ()):
        if tried["rule"] == choice["rule"] and "value" in tried:
            return tried["value"], tried["error"]
    return None

"""The user model of a run on held-out rows, and what its rule gains and costs in knowledge."""

from collections.abc import Mapping
from typing import Any

from ucfrec.reporting.charts import LineChart, line_chart
from ucfrec.reporting.tables import Table, shown
from ucfrec.runs.record import Candidate, RunRecord


def user_model_table(record: RunRecord) -> Table | None:
    """The held-out loss of every part of the user model beside simpler parts; None without one."""
    reward, rule = record.reward_model, record.rule
    if reward is None or rule is None:
        return None
    rows: dict[str, Any] = {
        "reward: loss of the mean": reward.base_loss,
        "reward: loss of item effects": reward.item_loss,
        "reward: loss of the model": reward.loss,
    }
    for tried in reward.effects:
        kept = "" if tried.kept else ", excluded"
        rows[f"gain by {tried.effect}"] = f"{tried.gain:.5f} ± {tried.gain_error:.5f}{kept}"
    if (end := rule.session_end) is not None:
        rows |= {f"session end: loss, {kind}": loss for kind, loss in end.loss.items()}
        rows["session end: kept"] = end.kept
    if (estimate := rule.estimate) is not None:
        rows["estimated value"] = f"{estimate.value:.4g} ± {estimate.error:.2g}"
        rows["in either half of the users"] = " and ".join(f"{v:.4g}" for v in estimate.halves)
        if estimate.optimism is not None:
            off, error = estimate.optimism
            rows["rewards expected too high by"] = f"{off:+.1%} ± {error:.1%}"
        rows["cannot be trusted, as"] = "; ".join(estimate.doubts) or "-"
    if rule.halves_agree is not None:
        rows["halves that choose this rule"] = sum(rule.halves_agree)
    body = [(name, [each if isinstance(each, str) else shown(each)]) for name, each in rows.items()]
    return Table("User model, on held-out rows", "", ["value"], body)


def frontier(record: RunRecord) -> tuple[LineChart, Table] | None:
    """The highest estimated value of the rules that leave so many effective users of the log.

    None where the log has no propensities.
    """
    best = list[Candidate]()
    known = [each for each in _candidates(record) if _users(each) is not None]
    for each in sorted(known, key=lambda one: (-(_users(one) or 0.0), -(one.value or 0.0))):
        if not best or (each.value or 0.0) > (best[-1].value or 0.0):
            best.append(each)
    if not best or record.rule is None:
        return None
    curve: Mapping[float, float] = {_users(each) or 0.0: each.value or 0.0 for each in best}
    chosen = next((each for each in known if each.rule == record.rule.rule), None)
    curves = [("best rule", 0, curve)]
    if chosen is not None:
        curves.append(("chosen rule", 1, {_users(chosen) or 0.0: chosen.value or 0.0}))
    title = "Estimated value against evidence"
    chart = line_chart(title, "effective users of the log", curves)
    head = ["estimated value", "effective users", "off-policy interval"]
    return chart, Table(title, "rule", head, [(str(each.rule), _numbers(each)) for each in best])


def _candidates(record: RunRecord) -> tuple[Candidate, ...]:
    return () if record.rule is None else record.rule.candidates


def _users(candidate: Candidate) -> float | None:
    evidence = candidate.evidence
    return None if evidence is None or candidate.value is None else evidence.effective_users


def _numbers(candidate: Candidate) -> list[str]:
    interval = None if candidate.evidence is None else candidate.evidence.interval
    ends = "-" if interval is None else f"{interval[0]:.4g} to {interval[1]:.4g}"
    return [shown(candidate.value), f"{_users(candidate) or 0.0:.0f}", ends]

"""The page of the explorer as HTML, from what a visitor asked for."""

import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.errors import InputError
from ucfrec.exploring.explain import PARTS, Explained, explain, pasted_history
from ucfrec.files.record import CARD
from ucfrec.python_api.given_data import histories_given
from ucfrec.recommending.histories import Histories
from ucfrec.recommending.recommend import some_of
from ucfrec.reporting.charts import Chart, line_chart
from ucfrec.reporting.page import template, write_report
from ucfrec.reporting.page_results import find_quoted, read_evidence
from ucfrec.results.row import ResultRow
from ucfrec.runs.trained_policy import TrainedPolicy

_PACKAGE: Final = "ucfrec.exploring"
_TITLES: Final = ("title", "name")
_IMAGES: Final = ("image", "image_url", "picture")
_NUMBER: Final = re.compile(r"-?\d{1,12}(\.\d{1,12})?")
_USERS_LISTED: Final = 1000
_MOST_ITEMS: Final = 100


@dataclass(frozen=True)
class Slider:
    """One number of the rule that a visitor can change."""

    name: str
    """Field of `DecisionRule`."""
    label: str
    low: float
    high: float
    step: float
    value: float


class Explorer:
    """Runs that are tried out, and what the page shows of them."""

    def __init__(
        self,
        runs: Sequence[TrainedPolicy],
        features: pa.Table | None = None,
        results: Sequence[Path] = (),
    ) -> None:
        """
        Args:
            runs: one policy of items, or two that are compared.
            features: of items, with a column `item_id`; None for none.
            results: files of `ucfrec ope --json` and `ucfrec evaluate --json`, for the report.

        Raises:
            InputError: a policy's actions are vectors, or there are none or more than two.
        """
        if not 1 <= len(runs) <= 2:
            raise InputError(f"{len(runs)} runs are named; name one, or two to compare")
        for trained in runs:
            trained.item_scorer()
        self.runs, self._results = tuple(runs), tuple(results)
        rows = [] if features is None else features.to_pylist()
        self._features = {str(row[schema.ITEM_ID]): row for row in rows}

    def page(self, given: Mapping[str, str]) -> str:
        """The whole page.

        Args:
            given: fields of the form by name; unknown ones are ignored.
        """
        return template(_PACKAGE, "explore.html").render(
            **self._shown(given),
            given=given,
            runs=[(run.folder.name, run, self._card(run)) for run in self.runs],
            sliders=self._sliders(given),
            values=self.values,
            chart=self.values_chart,
            users=self.runs[0].user_ids[:_USERS_LISTED].tolist(),
        )

    def results(self, given: Mapping[str, str]) -> str:
        """The part of the page that changes with the form."""
        return template(_PACKAGE, "explore_results.html").render(**self._shown(given))

    @cached_property
    def values(self) -> list[tuple[float, str, ResultRow]]:
        """Off-policy estimates by target return: the target, the policy, the row of the verdict."""
        found = []
        for one in read_evidence(self._results).estimates:
            row = find_quoted(one.rows)
            if row is not None and row.target_return is not None and row.interval is not None:
                found.append((row.target_return, one.name, row))
        return sorted(found, key=lambda each: each[:2])

    @cached_property
    def values_chart(self) -> Chart | None:
        """The values as one curve per policy; None with fewer than two targets."""
        curves: dict[str, dict[float, float]] = {}
        for target, _, row in self.values:
            curves.setdefault(row.policy, {})[target] = row.value
        if max(map(len, curves.values()), default=0) < 2:
            return None
        named = [(name, style, curve) for style, (name, curve) in enumerate(curves.items())]
        return line_chart("Off-policy value against the target return", "target return", named)

    @cached_property
    def reports(self) -> list[str]:
        """The report of each run: verdict, curves and samples, as an HTML page."""
        pages = []
        for trained in self.runs:
            with tempfile.TemporaryDirectory() as scratch:
                file = Path(scratch) / "report.html"
                write_report(file, [trained.folder], self._results)
                pages.append(file.read_text(encoding="utf-8"))
        return pages

    def _shown(self, given: Mapping[str, str]) -> dict[str, Any]:
        """Lists and error, for the templates."""
        lists: list[tuple[str, str, Explained]] = []
        error = ""
        try:
            if given.get("user", "").strip() or given.get("history", "").strip():
                lists = [self._list(trained, given) for trained in self.runs]
        except InputError as fault:
            lists, error = [], str(fault)
        ids = [{str(card.item_id) for card in each.cards} for _, _, each in lists]
        common = set.intersection(*ids) if len(ids) == 2 else None
        widths = [
            abs(v) for _, _, each in lists for card in each.cards for v in card.parts.values()
        ]
        return {
            "lists": lists,
            "error": error,
            "common": common,
            "parts": PARTS,
            "widest": max(widths, default=0.0) or 1.0,
            "item": self._item,
        }

    def _list(self, trained: TrainedPolicy, given: Mapping[str, str]) -> tuple[str, str, Explained]:
        text, user = given.get("history", "").strip(), given.get("user", "").strip()
        history = _pasted(trained, text) if text else _stored(trained, user)
        rule = _rule_given(trained, given)
        k = round(_number(given, "k", 10, 1, _MOST_ITEMS))
        filter_seen = given.get("keep_seen") is None
        found = explain(trained, rule, history, k, filter_seen)
        return trained.folder.name, str(rule), found

    def _sliders(self, given: Mapping[str, str]) -> list[Slider]:
        trained = self.runs[0]
        rule, returns = trained.rule, trained.training_returns
        low, high = float(returns[0]), float(returns[-1])
        target = high if rule.target is None else rule.target
        span = max(high - low, abs(high), 1e-6)
        sliders = [
            Slider("target", "Target return", low, high + span / 2, span / 100, target),
            Slider("temperature", "Temperature", 0, 2, 0.05, rule.temperature),
            Slider("tag_window", "Exclude tags of the last items", 0, 10, 1, rule.tag_window),
        ]
        if trained.reward_model is not None:
            weight = Slider("reward_weight", "Reward weight", 0, 32, 0.25, rule.reward_weight)
            sliders.insert(1, weight)
        states = trained.item_states
        if states is None or not bool((states.tags >= 0).any()):
            sliders.pop()
        if given.get("custom") is None:
            return sliders
        # Where a number is wrong, the list says so.
        return [
            replace(each, value=float(given[each.name]))
            if _NUMBER.fullmatch(given.get(each.name, ""))
            else each
            for each in sliders
        ]

    def _item(self, item_id: Any) -> dict[str, Any]:
        """Title, picture and other features of an item."""
        row = dict(self._features.get(str(item_id), {}))
        row.pop(schema.ITEM_ID, None)
        title = next((row.pop(name) for name in _TITLES if name in row), None)
        image = next((str(row.pop(name)) for name in _IMAGES if name in row), "")
        others = "; ".join(f"{name} {value}" for name, value in row.items() if value)
        return {
            "title": str(title or item_id),
            "image": image if image.startswith(("http://", "https://")) else "",
            "features": others[:200],
        }

    @staticmethod
    def _card(trained: TrainedPolicy) -> str:
        card = trained.folder / CARD
        return card.read_text(encoding="utf-8") if card.exists() else "There is no model card."


def _pasted(trained: TrainedPolicy, text: str) -> Histories:
    (history,) = histories_given(trained, pasted_history(text), None, ["pasted"])
    known = trained.items.numbers(history.item_ids) >= 0
    if not known.all():
        unknown = some_of(list(dict.fromkeys(history.item_ids[~known].tolist())))
        raise InputError(
            f"the run {trained.folder.name} does not know the items {unknown:.200}; take their "
            "lines out of the history"
        )
    return history


def _stored(trained: TrainedPolicy, user: str) -> Histories:
    run = trained.folder.name
    if trained.users.numbers(np.asarray([user]))[0] < 0:
        raise InputError(
            f"the run {run} has no user {user[:60]!r}; choose one of the list, or paste a history"
        )
    if trained.training_store() is None:
        raise InputError(
            f"the store of the run {run}, {trained.record.store}, is gone or has changed; paste a "
            "history instead"
        )
    (history,) = histories_given(trained, None, None, [user])
    return history


def _rule_given(trained: TrainedPolicy, given: Mapping[str, str]) -> DecisionRule:
    """The run's own rule, or that of the sliders."""
    rule = trained.rule
    if given.get("custom") is None:
        return rule
    names = [name for name in ("target", "reward_weight", "temperature") if name in given]
    changes: dict[str, Any] = {name: _number(given, name, 0.0, -1e12, 1e12) for name in names}
    if "tag_window" in given:
        changes["tag_window"] = round(_number(given, "tag_window", 0, 0, 10))
    return replace(rule, **changes)


def _number(given: Mapping[str, str], name: str, default: float, low: float, high: float) -> float:
    text = given.get(name, "")
    if not text.strip():
        return default
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise InputError(f"{name} is {text[:40]!r}; give a number from {low:g} to {high:g}")
    return value

"""The explorer: its page as HTML, from what a visitor asked for, and its web application."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.errors import InputError
from ucfrec.exploring.explain import explain, read_pasted
from ucfrec.files.record import CARD
from ucfrec.logs.histories import Histories
from ucfrec.python_api.given_data import read_histories
from ucfrec.reporting.charts import Chart, line_chart
from ucfrec.reporting.page import render_report, template
from ucfrec.reporting.results import find_quoted, read_evidence
from ucfrec.runs.trained_policy import TrainedPolicy

_PACKAGE = "ucfrec.exploring"
_TITLES = ("title", "name")
_IMAGES = ("image", "image_url", "picture")
_USERS_LISTED = 1000
_MOST_ITEMS = 100
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; connect-src 'self'; style-src 'unsafe-inline'; "
        "img-src http: https:; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}


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
            features: of items, with a column `item_id`; None for none.
            results: files of `ucfrec ope --json` and `ucfrec evaluate --json`, for the report.

        Raises:
            InputError: a policy's actions are vectors, there are none or more than two, or a file
                of results cannot be used.
        """
        if not 1 <= len(runs) <= 2:
            raise InputError(f"{len(runs)} runs are named; name one, or two to compare")
        for trained in runs:
            trained.item_scorer()
        self.runs, self._results = tuple(runs), tuple(results)
        self.values = sorted(
            (
                (row.target_return, estimates.name, row)
                for estimates in read_evidence(results)[1]
                if (row := find_quoted(estimates.rows)) and row.target_return is not None
            ),
            key=lambda value: value[:2],
        )
        """Off-policy estimates by target return: the target, the policy, the row of the verdict."""
        rows = [] if features is None else features.to_pylist()
        self._features = {str(row.pop(schema.ITEM_ID)): row for row in rows}

    def page(self, fields: Mapping[str, str]) -> str:
        """The whole page, for the fields of the form by name; unknown ones are ignored."""
        runs = []
        for folder in (run.folder for run in self.runs):
            text = "There is no model card."
            if (folder / CARD).exists():
                text = (folder / CARD).read_text(encoding="utf-8", errors="backslashreplace")
            runs.append((folder.name, text))
        return template(_PACKAGE, "explore.html").render(
            **self._fill(fields),
            given=fields,
            runs=runs,
            sliders=self._list_sliders(fields),
            values=self.values,
            chart=self.values_chart,
            users=self.runs[0].user_ids[:_USERS_LISTED].tolist(),
        )

    def results(self, fields: Mapping[str, str]) -> str:
        """The part of the page that changes with the form."""
        return template(_PACKAGE, "explore_results.html").render(**self._fill(fields))

    @cached_property
    def values_chart(self) -> Chart | None:
        """The values as one curve per policy; None with fewer than two targets."""
        curves: dict[str, dict[float, float]] = {}
        for target, _, row in self.values:
            curves.setdefault(row.policy, {})[target] = row.value
        if max(map(len, curves.values()), default=0) < 2:
            return None
        lines = [(name, style, curves[name]) for style, name in enumerate(curves)]
        return line_chart("Off-policy value against the target return", "target return", lines)

    @cached_property
    def reports(self) -> list[str]:
        """The report of each run: verdict, curves and samples, as an HTML page."""
        return [render_report([trained.folder], self._results) for trained in self.runs]

    def _fill(self, fields: Mapping[str, str]) -> dict[str, Any]:
        """Lists and error, for the templates."""
        lists, error = [], ""
        try:
            if fields.get("user", "").strip() or fields.get("history", "").strip():
                k = round(_read_number(fields, "k", 1, _MOST_ITEMS, 10))
                for trained in self.runs:
                    history, rule = _read_history(trained, fields), _read_rule(trained, fields)
                    reasons = explain(trained, rule, history, k, "keep_seen" not in fields)
                    lists.append((trained.folder.name, str(rule), reasons))
        except InputError as fault:
            lists, error = [], str(fault)
        ids = [{str(card.item_id) for card in reasons.cards} for *_, reasons in lists]
        cards = (card for *_, reasons in lists for card in reasons.cards)
        return {
            "lists": lists,
            "error": error,
            "common": ids[0] & ids[1] if len(ids) == 2 else None,
            "widest": max((abs(x) for card in cards for x in card.parts.values()), default=0) or 1,
            "item": self._describe_item,
        }

    def _list_sliders(self, fields: Mapping[str, str]) -> list[tuple[Any, ...]]:
        """Numbers that a visitor can change: field of `DecisionRule`, label, range, step, value."""
        trained, states = self.runs[0], self.runs[0].item_states
        lowest, highest = float(trained.training_returns[0]), float(trained.training_returns[-1])
        span = max(highest - lowest, abs(highest), 1e-6)
        sliders = [("target", "Target return", lowest, highest + span / 2, span / 100)]
        if trained.reward_model is not None:
            sliders.append(("reward_weight", "Reward weight", 0, 32, 0.25))
        sliders.append(("temperature", "Temperature", 0, 2, 0.05))
        if states is not None and bool((states.tags >= 0).any()):
            sliders.append(("tag_window", "Exclude tags of the last items", 0, 10, 1))
        set_to = []
        for name, label, low, high, step in sliders:
            value = getattr(trained.rule, name)
            # Where a number is wrong, the list says so.
            if "custom" in fields and fields.get(name):
                with suppress(InputError):
                    value = _read_number(fields, name, low, high)
            set_to.append((name, label, low, high, step, highest if value is None else value))
        return set_to

    def _describe_item(self, item_id: Any) -> dict[str, str]:
        """Title, picture and other features of an item."""
        row = {**self._features.get(str(item_id), {})}
        title = next((row.pop(name) for name in _TITLES if name in row), None)
        image = next((str(row.pop(name)) for name in _IMAGES if name in row), "")
        features = "; ".join(f"{name} {value}" for name, value in row.items() if value)
        return {
            "title": str(title or item_id),
            "image": image if image.startswith(("http://", "https://")) else "",
            "features": features[:200],
        }


def _read_history(trained: TrainedPolicy, fields: Mapping[str, str]) -> Histories:
    """The history that is pasted, else that of the user in the store."""
    if text := fields.get("history", "").strip():
        return next(read_histories(trained, read_pasted(text), None, ["pasted"]))
    run, user = trained.folder.name, fields.get("user", "").strip()
    if trained.users.numbers(np.asarray([user]))[0] < 0:
        raise InputError(
            f"the run {run} has no user {user[:60]!r}; choose one of the list, or paste a history"
        )
    if trained.training_store() is None:
        raise InputError(
            f"the store of the run {run}, {trained.record.store}, is gone or has changed; paste a "
            "history instead"
        )
    return next(read_histories(trained, None, None, [user]))


def _read_rule(trained: TrainedPolicy, fields: Mapping[str, str]) -> DecisionRule:
    """The run's own rule, or that of the sliders."""
    if fields.get("custom") is None:
        return trained.rule
    changes: dict[str, Any] = {
        name: _read_number(fields, name, -1e12, 1e12)
        for name in ("target", "reward_weight", "temperature")
        if name in fields
    }
    if "tag_window" in fields:
        changes["tag_window"] = round(_read_number(fields, "tag_window", 0, 10))
    return replace(trained.rule, **changes)


def _read_number(
    fields: Mapping[str, str],
    name: str,
    low: float,
    high: float,
    default: float = 0.0,
) -> float:
    text = fields.get(name, "")
    try:
        value = float(text) if text.strip() else default
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise InputError(f"{name} is {text[:40]!r}; give a number from {low:g} to {high:g}")
    return value


def application(explorer: Explorer, allowed_hosts: Sequence[str]) -> Starlette:
    """The application, which answers the given values of `Host` and keeps no state of visitors."""
    script = files(_PACKAGE).joinpath("explore.js").read_text(encoding="utf-8")

    def answer(text: str, kind: str = "html") -> Response:
        # Texts of files may have bytes that are not valid Unicode.
        content = text.encode("utf-8", errors="backslashreplace")
        return Response(content, headers=_HEADERS, media_type=f"text/{kind}; charset=utf-8")

    def report(request: Request) -> Response:
        number = request.path_params["number"]
        if number >= len(explorer.runs):
            return Response("there is no such run", 404)
        return answer(explorer.reports[number])

    routes = [
        Route("/", lambda request: answer(explorer.page(request.query_params))),
        Route("/results", lambda request: answer(explorer.results(request.query_params))),
        Route("/explore.js", lambda _: answer(script, "javascript")),
        Route("/report/{number:int}", report),
    ]
    hosts = Middleware(TrustedHostMiddleware, allowed_hosts=[*allowed_hosts], www_redirect=False)
    return Starlette(routes=routes, middleware=[hosts])

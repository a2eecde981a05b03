"""The explorer: its page as HTML, from what a visitor asked for, and its web application."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from fastapi import FastAPI, Request, Response
from starlette.middleware.trustedhost import TrustedHostMiddleware

from ucfrec import schema
from ucfrec.acting.decision import DecisionRule
from ucfrec.errors import InputError
from ucfrec.exploring.explain import PARTS, explain, read_pasted
from ucfrec.files.record import CARD
from ucfrec.logs.histories import Histories
from ucfrec.python_api.given_data import read_histories
from ucfrec.recommending.recommend import name_some
from ucfrec.reporting.charts import Chart, line_chart
from ucfrec.reporting.page import render_report, template
from ucfrec.reporting.results import find_quoted, read_evidence
from ucfrec.runs.trained_policy import TrainedPolicy

_PACKAGE: Final = "ucfrec.exploring"
_TITLES: Final = ("title", "name")
_IMAGES: Final = ("image", "image_url", "picture")
_NUMBER: Final = re.compile(r"-?\d{1,12}(\.\d{1,12})?")
_USERS_LISTED: Final = 1000
_MOST_ITEMS: Final = 100
_HEADERS: Final = {
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
        self._features = {str(row[schema.ITEM_ID]): row for row in rows}

    def page(self, fields: Mapping[str, str]) -> str:
        """The whole page, for the fields of the form by name; unknown ones are ignored."""
        runs = []
        for run in self.runs:
            card, text = run.folder / CARD, "There is no model card."
            if card.exists():
                text = card.read_text(encoding="utf-8", errors="backslashreplace")
            runs.append((run.folder.name, run, text))
        return template(_PACKAGE, "explore.html").render(
            **self._fill(fields),
            given=fields,
            runs=runs,
            sliders=self._sliders(fields),
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
                    filter_seen = fields.get("keep_seen") is None
                    explained = explain(trained, rule, history, k, filter_seen)
                    lists.append((trained.folder.name, str(rule), explained))
        except InputError as fault:
            lists, error = [], str(fault)
        ids = [{str(card.item_id) for card in explained.cards} for *_, explained in lists]
        cards = (card for *_, explained in lists for card in explained.cards)
        widest = max((abs(part) for card in cards for part in card.parts.values()), default=0.0)
        return {
            "lists": lists,
            "error": error,
            "common": ids[0] & ids[1] if len(ids) == 2 else None,
            "parts": PARTS,
            "widest": widest or 1.0,
            "item": self._item,
        }

    def _sliders(self, fields: Mapping[str, str]) -> list[dict[str, Any]]:
        """The numbers of the rule that a visitor can change, fields of `DecisionRule`."""
        trained, states = self.runs[0], self.runs[0].item_states
        lowest, highest = float(trained.training_returns[0]), float(trained.training_returns[-1])
        span = max(highest - lowest, abs(highest), 1e-6)
        sliders = [("target", "Target return", lowest, highest + span / 2, span / 100)]
        if trained.reward_model is not None:
            sliders.append(("reward_weight", "Reward weight", 0, 32, 0.25))
        sliders.append(("temperature", "Temperature", 0, 2, 0.05))
        if states is not None and bool((states.tags >= 0).any()):
            sliders.append(("tag_window", "Exclude tags of the last items", 0, 10, 1))
        shown = []
        for name, label, low, high, step in sliders:
            value, text = getattr(trained.rule, name), fields.get(name, "")
            # Where a number is wrong, the list says so.
            if fields.get("custom") is not None and _NUMBER.fullmatch(text):
                value = float(text)
            slider = {"name": name, "label": label, "low": low, "high": high, "step": step}
            shown.append({**slider, "value": highest if value is None else value})
        return shown

    def _item(self, item_id: Any) -> dict[str, Any]:
        """Title, picture and other features of an item."""
        row = {**self._features.get(str(item_id), {})}
        row.pop(schema.ITEM_ID, None)
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
    run, text = trained.folder.name, fields.get("history", "").strip()
    if text:
        (history,) = read_histories(trained, read_pasted(text), None, ["pasted"])
        unknown = history.item_ids[trained.items.numbers(history.item_ids) < 0]
        if len(unknown):
            names = name_some(list(dict.fromkeys(unknown.tolist())))
            raise InputError(
                f"the run {run} does not know the items {names:.200}; take their lines out of the "
                "history"
            )
        return history
    user = fields.get("user", "").strip()
    if trained.users.numbers(np.asarray([user]))[0] < 0:
        raise InputError(
            f"the run {run} has no user {user[:60]!r}; choose one of the list, or paste a history"
        )
    if trained.training_store() is None:
        raise InputError(
            f"the store of the run {run}, {trained.record.store}, is gone or has changed; paste a "
            "history instead"
        )
    (history,) = read_histories(trained, None, None, [user])
    return history


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
    fields: Mapping[str, str], name: str, low: float, high: float, default: float = 0.0
) -> float:
    text = fields.get(name, "")
    try:
        value = float(text) if text.strip() else default
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise InputError(f"{name} is {text[:40]!r}; give a number from {low:g} to {high:g}")
    return value


def application(explorer: Explorer, allowed_hosts: Sequence[str]) -> FastAPI:
    """The application, which answers the given values of `Host` and keeps no state of visitors."""
    app = FastAPI(title="ucfrec explorer", docs_url=None, redoc_url=None, openapi_url=None)
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=[*allowed_hosts], www_redirect=False)
    script = files(_PACKAGE).joinpath("explore.js").read_text(encoding="utf-8")

    def html(text: str) -> Response:
        # Texts of files may have bytes that are not valid Unicode.
        content = text.encode("utf-8", errors="backslashreplace")
        return Response(content, media_type="text/html; charset=utf-8", headers=_HEADERS)

    @app.get("/")
    def page(request: Request) -> Response:
        return html(explorer.page(request.query_params))

    @app.get("/results")
    def results(request: Request) -> Response:
        return html(explorer.results(request.query_params))

    @app.get("/explore.js")
    def javascript() -> Response:
        return Response(script, media_type="text/javascript; charset=utf-8", headers=_HEADERS)

    @app.get("/report/{number}")
    def report(number: int) -> Response:
        if not 0 <= number < len(explorer.runs):
            return Response("there is no such run", 404)
        return html(explorer.reports[number])

    return app

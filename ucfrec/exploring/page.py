"""The explorer: its page as HTML, from what a visitor asked for, and its web application."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property, partial
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
from ucfrec.errors import InputError
from ucfrec.exploring.explain import Explained, explain, read_pasted
from ucfrec.logs.histories import Histories
from ucfrec.python_api.given_data import read_histories
from ucfrec.reporting.items import describe_item, features_by_id
from ucfrec.reporting.page import render_report, template
from ucfrec.reporting.results import read_findings
from ucfrec.runs.trained_policy import TrainedPolicy

_PACKAGE = "ucfrec.exploring"
_UNSET = {"k": "10"}
"""Numbers of the form where it has none; others are 0."""
_EXAMPLES, _EXAMPLE_ROWS = 5, 10
"""Number of example users, and of the rows that suit one."""
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
        self._findings = read_findings(self._results)
        self._features = features_by_id(features)

    def page(self, fields: Mapping[str, str]) -> str:
        """The whole page, for the fields of the form by name; unknown ones are ignored."""
        return template(_PACKAGE, "explore.html").render(
            **self._fill(fields),
            given=fields,
            unset=_UNSET,
            names=[run.folder.name for run in self.runs],
            sliders=self.sliders,
            findings=self._findings,
            users=self.runs[0].user_ids[:_USERS_LISTED].tolist(),
        )

    def results(self, fields: Mapping[str, str]) -> str:
        """The part of the page that changes with the form."""
        return template(_PACKAGE, "explore_results.html").render(**self._fill(fields))

    @cached_property
    def examples(self) -> list[Any]:
        """Users that every run knows, who have about `_EXAMPLE_ROWS` rows; none without stores."""
        ids, store = self.runs[0].user_ids, self.runs[0].training_store()
        if store is None or not len(ids):
            return []
        rows = np.bincount(store.episode_values(schema.USER), store.lengths, len(ids))
        ids = ids[np.argsort(np.abs(rows - _EXAMPLE_ROWS), kind="stable")]
        for trained in self.runs:
            ids = ids[trained.users.numbers(ids) >= 0]
        return list(ids[:_EXAMPLES])

    @cached_property
    def reports(self) -> list[str]:
        """The report of each run: verdict, curves and samples, as an HTML page."""
        return [render_report([trained.folder], self._results) for trained in self.runs]

    def _fill(self, fields: Mapping[str, str]) -> dict[str, Any]:
        """Lists and error, for the templates."""
        lists, error = [], ""
        if "user" not in fields and self.examples:
            fields = {**fields, "user": str(self.examples[0])}
        try:
            if fields.get("user", "").strip() or fields.get("history", "").strip():
                lists = [(run.folder.name, self._explain(run, fields)) for run in self.runs]
        except InputError as fault:
            error = str(fault)
        ids = [{str(card.item_id) for card in reasons.cards} for _, reasons in lists]
        cards = (card for _, reasons in lists for card in reasons.cards)
        return {
            "user": (user := fields.get("user", "")),
            "shown_to": "this user" if fields.get("history", "").strip() else f"user {user}",
            "examples": self.examples,
            "lists": lists,
            "error": error,
            "common": ids[0] & ids[1] if len(ids) == 2 else None,
            "widest": max((abs(x) for card in cards for x in card.parts.values()), default=0) or 1,
            "item": partial(describe_item, self._features),
        }

    @cached_property
    def sliders(self) -> list[tuple[Any, ...]]:
        """Numbers that a visitor can change: field of the rule, label, range, step, default."""
        trained, rule, states = self.runs[0], self.runs[0].rule, self.runs[0].item_states
        lowest, highest = float(trained.training_returns[0]), float(trained.training_returns[-1])
        span = max(highest - lowest, abs(highest), 1e-6)
        sliders = [("target", "Target return", lowest, highest + span / 2, span / 100, rule.target)]
        if trained.reward_model is not None:
            sliders.append(("reward_weight", "Reward weight", 0, 32, 0.25, rule.reward_weight))
        sliders.append(("temperature", "Temperature", 0, 2, 0.05, rule.temperature))
        if states is not None and bool((states.tags >= 0).any()):
            sliders.append(("tag_window", "Exclude tags of the last", 0, 10, 1, rule.tag_window))
        return sliders

    def _explain(self, trained: TrainedPolicy, fields: Mapping[str, str]) -> Explained:
        """What a run recommends as the form asks for, by its own rule or that of the sliders."""
        numbers = {
            name: _read_number(fields, name, low, high)
            for name, _, low, high, *_ in self.sliders
            if name in fields and "custom" in fields
        }
        candidates = [line.strip() for line in fields.get("candidates", "").split("\n")]
        return explain(
            trained,
            replace(trained.rule, **numbers),
            _read_history(trained, fields),
            _read_number(fields, "k", 1, _MOST_ITEMS),
            "keep_seen" not in fields,
            candidates=[item_id for item_id in candidates if item_id] or None,
            time_ms=_read_time(fields),
            seed=_read_number(fields, "seed", 0, 2**31),
        )


def _read_time(fields: Mapping[str, str]) -> int | None:
    """The moment of the decision in milliseconds; None for right after the last row."""
    text = fields.get("time", "").strip()
    try:
        moment = datetime.fromisoformat(text) if text else None
    except ValueError:
        raise InputError(f"time is {text[:40]!r}; give one such as 2024-05-01T10:00") from None
    return None if moment is None else round(1000 * moment.replace(tzinfo=UTC).timestamp())


def _read_history(trained: TrainedPolicy, fields: Mapping[str, str]) -> Histories:
    """The history that is pasted, else that of the user in the store."""
    if text := fields.get("history", "").strip():
        return next(read_histories(trained, read_pasted(text), None, ["pasted"]))
    run, user = trained.folder.name, fields.get("user", "").strip()
    if trained.users.numbers(np.asarray([user]))[0] < 0:
        raise InputError(
            f"the run {run} has no user {user[:60]!r}; choose one of the list, or paste a history"
        )
    trained.require_store("paste a history instead")
    return next(read_histories(trained, None, None, [user]))


def _read_number(fields: Mapping[str, str], name: str, low: float, high: float) -> Any:
    """A number of the form, as an integer if it is one."""
    text = fields.get(name, "").strip() or _UNSET.get(name, "0")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise InputError(f"{name} is {text[:40]!r}; give a number from {low:g} to {high:g}")
    return int(value) if value.is_integer() else value


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

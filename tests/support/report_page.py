"""Reports as tests read them, and rows to put into them."""

import json
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from tests.support.result_rows import result_row
from ucfrec.files.atomic import read_json
from ucfrec.off_policy.estimators import SUITE
from ucfrec.reporting.page import write_report
from ucfrec.results.rows import ResultRow

VOID = {"meta", "br", "img", "link", "input", "hr"}
HOSTILE = "</title><script>alert('1')</script><img src=x onerror=\"alert(2)\">&amp;"

SOURCE: dict[str, Any] = {
    "rows_read": 1200,
    "dropped": {"null_key": 3, "duplicate": 12, "conflicting_duplicate": 6, "short_episode": 0},
    "unsorted_rows": 4,
    "steps": 1179,
    "items": 9,
    **{"reward": "r", "session_by": "gap", "reward_statistics": {"mean": 0.5}},
    **{"splits": {}, "files": ["log.csv"], "users": 90, "sessions": 8, "sessions_cut": 0},
    **{"conflicting_duplicates": 6, "equal_times": 0, "time_range_ms": [0, 86_400_000]},
}
"""What `prepare` reports of a store."""


class Page(HTMLParser):
    """What a page holds; fails where tags do not match."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tables: dict[str, dict[str, dict[str, str]]] = {}
        """{caption: {row: {column: cell}}}"""
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.raw = path.read_text(encoding="utf-8")
        self._open: list[str] = []
        self._rows: list[list[str]] = []
        self._caption = self._cell = ""
        self.feed(self.raw)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)
        if tag == "table":
            self._rows, self._caption = [], ""
        elif tag == "tr":
            self._rows.append([])
        elif tag in ("td", "th"):
            self._cell = ""
            assert tag == "td" or dict(attrs)["scope"] in ("row", "col")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag
        if tag in ("td", "th"):
            self._rows[-1].append(self._cell.strip())
        elif tag == "table":
            head, *body = self._rows
            rows = {row[0]: dict(zip(head[1:], row[1:], strict=True)) for row in body}
            self.tables[self._caption] = rows

    def handle_data(self, data: str) -> None:
        self.text += data
        if self._open and self._open[-1] == "caption":
            self._caption += data
        self._cell += data


def page_of(out: Path, *runs: Path, results: tuple[Path, ...] = ()) -> Page:
    write_report(out, runs, results)
    return Page(out)


def record_of(run: Path) -> dict[str, Any]:
    record: dict[str, Any] = read_json(run / "run.json")
    record["files"] = {}  # checksums of files that the test changes
    return record


def rewritten(run: Path, to: Path, **changes: Any) -> Path:
    """A copy of a run with another record; a change to None takes the field away."""
    shutil.copytree(run, to)
    record = record_of(run) | changes
    record = {k: v for k, v in record.items() if k not in changes or v is not None}
    (to / "run.json").write_text(json.dumps(record))
    return to


def row(environment: str, name: str, value: float, **more: Any) -> ResultRow:
    """A row of `ucfrec evaluate`: of a built-in policy without `training_seed`."""
    given = {"suite": "evaluate", "table": "evaluate", "training_seed": None, "checkpoint": None}
    given |= {"task": environment, "environment": environment, "method": name, "policy": name}
    return result_row(value, **given | {"interval": (value - 0.5, value + 1.5)} | more)


def estimate(name: str, value: float, policy: str = "ucf", **more: Any) -> ResultRow:
    """A row of `ucfrec ope`; `more` are metrics, conditions, details and other fields."""
    given = {"suite": SUITE, "task": "logs", "policy": policy}
    return row("logs", name, value, **given | more)


def number(cell: str) -> float:
    return float(cell.replace(",", ""))

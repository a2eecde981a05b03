"""Draw the pictures of the documentation: bar charts from tables on its pages, and badges.

    python docs/charts.py           # draw into docs/assets
    python docs/charts.py --check   # fail if a picture is not what its table says

A table is drawn if the line above it is a comment like

    <!-- chart: catalogue; Return per session; own, shared -->

that is, the name of the file (`chart-catalogue.svg`), the title, and the columns to draw. A cell is
a number or `number ± error`; other cells are not drawn. Pictures follow the reader's color scheme.
"""

import re
import sys
import tomllib
from collections.abc import Iterator
from html import escape
from pathlib import Path

from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
from ucfrec.results.charts import SERIES, SOFT, page_style, render  # noqa: E402

DOCS = ROOT / "docs"
ASSETS = DOCS / "assets"
WIDTH, NAME, BAR = 480, 17, 14
_CHART = re.compile(r"^<!-- chart: ([\w-]+); ([^;]+); ([^;]+) -->\n\n?((?:\|.*\n)+)", re.MULTILINE)
_VALUE = re.compile(r"^\**([+−-]?\d+(?:\.\d+)?)(?: ± (\d+(?:\.\d+)?))?\**$")
STYLE = """
    svg { --ink: #1f2328; --soft: #57606a; --paper: #ffffff; --rule: #d0d7de;
      --c0: #8c959f; --c1: #d55e00; --c2: #0072b2; --c3: #009e73;
      font-family: system-ui, -apple-system, "Segoe UI", Roboto, sans-serif }
    .panel { fill: var(--paper); stroke: var(--rule) }
    @media (prefers-color-scheme: dark) {
      svg { --ink: #e6edf3; --soft: #9aa4ae; --paper: #161b22; --rule: #30363d;
        --c0: #6e7681; --c1: #f0883e; --c2: #58a6ff; --c3: #3fb950 }
    }"""


def pictures() -> dict[str, str]:
    """File name to SVG text of every picture."""
    made = dict(_badges())
    for page in sorted(DOCS.glob("*.md")):
        for name, title, columns, table in _CHART.findall(page.read_text(encoding="utf-8")):
            made[f"chart-{name}.svg"] = _chart(title, columns.split(", "), table)
    return made


def _rows(table: str) -> Iterator[dict[str, str]]:
    lines = [
        [cell.strip() for cell in line.strip("| \n").split("|")] for line in table.splitlines()
    ]
    for cells in lines[2:]:
        yield dict(zip(lines[0], cells, strict=True))


def _number(cell: str) -> tuple[float, float, str] | None:
    """Mean, error and the mean as it is written; None for cells without a number."""
    found = _VALUE.match(cell)
    if not found:
        return None
    return float(found[1].replace("−", "-")), float(found[2] or 0), found[1]


@page_style()
def _chart(title: str, columns: list[str], table: str) -> str:
    rows = [(next(iter(row.values())), [_number(row[c]) for c in columns]) for row in _rows(table)]
    rows = [(name.replace("`", ""), values) for name, values in rows if any(values)]
    top, legend = 38, len(columns) > 1
    bars = sum(value is not None for _, values in rows for value in values)
    height = top + 20 * legend + len(rows) * (NAME + 5) + bars * BAR + 8
    figure = Figure(figsize=(WIDTH / 72, height / 72))
    figure.set_layout_engine("none")
    axes = figure.add_axes((14 / WIDTH, 0, 1 - 74 / WIDTH, 1))
    axes.set_axis_off()
    axes.set_ylim(height, 0)
    left = axes.get_yaxis_transform()
    axes.text(0, 26, title, transform=left, size=14, weight="bold")
    if legend:
        for k, column in enumerate(columns):
            at = 170 * k / (WIDTH - 74)
            axes.text(at, 48, "■", transform=left, size=12, color=SERIES[k])
            axes.text(at + 0.035, 47, column, transform=left, size=12, color=SOFT)
    y = top + 20 * legend
    for name, values in rows:
        axes.text(0, y + 13, name, transform=left, size=13)
        y += NAME
        start = y
        for k, value in enumerate(values):
            if value is None:
                continue
            mean, error, text = value
            color = SERIES[k if legend else int("UCF" in name)]
            middle = y + BAR / 2
            axes.barh(middle, mean, height=BAR - 2, color=color)
            axes.hlines(middle, mean - error, mean + error, color=SOFT, linewidth=1)
            axes.annotate(
                text, (max(mean, 0) + error, middle), (5, 0), textcoords="offset points",
                va="center", size=12, color=SOFT, annotation_clip=False,
            )  # fmt: skip
            y += BAR
        axes.vlines(0, start, y, color=SOFT, linewidth=1)
        y += 5
    ends = [end for _, values in rows for v in values if v for end in (v[0] - v[1], v[0] + v[1])]
    axes.set_xlim(min(0.0, *ends), max(ends))
    numbers = "; ".join(
        f"{name}: " + ", ".join("–" if v is None else v[2] for v in values) for name, values in rows
    )
    svg = render(figure, title, numbers).svg
    size = f'xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height}"'
    panel = f'<rect class="panel" x="1" y="1" width="{WIDTH - 2}" height="{height - 2}" rx="8"/>'
    start, _, body = svg.partition(">")
    start = start.replace("<svg", f"<svg {size}", 1)
    return f"{start}>\n  <style>{STYLE}\n  </style>\n  {panel}{body}"


def _badges() -> Iterator[tuple[str, str]]:
    """License and Python from pyproject.toml; types and tests as CONTRIBUTING.md states them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    python = project["project"]["requires-python"].removeprefix(">=").split(",")[0] + "+"
    types = "mypy strict" if project["tool"]["mypy"]["strict"] else "mypy"
    badges = {"license": project["project"]["license"], "python": python, "typed": types}
    badges["tests"] = "required to merge"
    for name, value in badges.items():
        left, right = 14 + 7 * len(name), 14 + 7 * len(value)
        yield (
            f"badge-{name}.svg",
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{left + right}" height="20" '
            f'role="img"><title>{name}: {escape(value)}</title>'
            f'<rect width="{left}" height="20" fill="#555"/>'
            f'<rect x="{left}" width="{right}" height="20" fill="#1a7f37"/>'
            '<g fill="#fff" font-family="Verdana, DejaVu Sans, sans-serif" font-size="11" '
            f'text-anchor="middle"><text x="{left / 2:g}" y="14">{name}</text>'
            f'<text x="{left + right / 2:g}" y="14">{escape(value)}</text></g></svg>\n',
        )


def main() -> int:
    """Draw the pictures, or with `--check` compare them; returns the exit status."""
    wrong = []
    for name, text in pictures().items():
        path = ASSETS / name
        if "--check" not in sys.argv[1:]:
            path.write_text(text, encoding="utf-8")
        elif not path.is_file() or path.read_text(encoding="utf-8") != text:
            wrong.append(name)
    if wrong:
        print(f"{', '.join(wrong)}: run python docs/charts.py", file=sys.stderr)
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())

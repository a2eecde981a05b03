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
from collections.abc import Callable, Iterator
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
ASSETS = DOCS / "assets"
WIDTH, LEFT, RIGHT, NAME, BAR = 480, 14, 60, 17, 14
_CHART = re.compile(r"^<!-- chart: ([\w-]+); ([^;]+); ([^;]+) -->\n\n?((?:\|.*\n)+)", re.MULTILINE)
_VALUE = re.compile(r"^\**([+−-]?\d+(?:\.\d+)?)(?: ± (\d+(?:\.\d+)?))?\**$")
STYLE = """
    .panel { fill: #ffffff; stroke: #d0d7de }
    .b0 { fill: #8c959f } .b1 { fill: #d55e00 } .b2 { fill: #0072b2 } .b3 { fill: #009e73 }
    .error, .axis { stroke: #57606a; stroke-width: 1 }
    text { font-family: system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; fill: #1f2328;
      font-size: 13px }
    .title { font-weight: 600; font-size: 14px }
    .number { font-size: 12px; fill: #57606a }
    @media (prefers-color-scheme: dark) {
      .panel { fill: #161b22; stroke: #30363d }
      .b0 { fill: #6e7681 } .b1 { fill: #f0883e } .b2 { fill: #58a6ff } .b3 { fill: #3fb950 }
      .error, .axis { stroke: #9aa4ae }
      text { fill: #e6edf3 }
      .number { fill: #9aa4ae }
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


def _chart(title: str, columns: list[str], table: str) -> str:
    rows = [(next(iter(row.values())), [_number(row[c]) for c in columns]) for row in _rows(table)]
    rows = [(name.replace("`", ""), values) for name, values in rows if any(values)]
    found = [value for _, values in rows for value in values if value]
    low = min(0.0, *(mean - error for mean, error, _ in found))
    scale = (WIDTH - LEFT - RIGHT) / (max(mean + error for mean, error, _ in found) - low)

    def x(value: float) -> float:
        return round(LEFT + (value - low) * scale, 1)

    parts = [f'<text class="title" x="{LEFT}" y="26">{escape(title)}</text>']
    if len(columns) > 1:
        for k, column in enumerate(columns):
            at = LEFT + k * 170
            parts.append(f'<rect class="b{k}" x="{at}" y="38" width="10" height="10"/>')
            parts.append(f'<text class="number" x="{at + 15}" y="47">{escape(column)}</text>')
    y = 58 if len(columns) > 1 else 38
    for name, values in rows:
        parts.append(f'<text x="{LEFT}" y="{y + 13}">{escape(name)}</text>')
        y += NAME
        for k, value in enumerate(values):
            if value is not None:
                color = k if len(columns) > 1 else int("UCF" in name)
                parts += _bar(y, x, value, color)
                y += BAR
        drawn = BAR * sum(value is not None for value in values)
        parts.append(f'<line class="axis" x1="{x(0)}" x2="{x(0)}" y1="{y - drawn}" y2="{y}"/>')
        y += 5
    said = "; ".join(
        f"{name}: " + ", ".join("–" if v is None else v[2] for v in values) for name, values in rows
    )
    return _svg(WIDTH, y + 8, title, said, parts)


def _bar(
    y: int, x: Callable[[float], float], value: tuple[float, float, str], color: int
) -> list[str]:
    mean, error, text = value
    start, end = sorted((x(0), x(mean)))
    middle = y + BAR / 2
    drawn = [
        f'<rect class="b{color}" x="{start}" y="{y + 1}" width="{max(end - start, 1):.1f}" '
        f'height="{BAR - 2}"/>'
    ]
    if error:
        ends = f'x1="{x(mean - error)}" x2="{x(mean + error)}" y1="{middle:g}" y2="{middle:g}"'
        drawn.append(f'<line class="error" {ends}/>')
    right = x(max(mean, 0) + error) + 5
    drawn.append(f'<text class="number" x="{right:g}" y="{middle + 4:g}">{text}</text>')
    return drawn


def _svg(width: int, height: int, title: str, about: str, parts: list[str]) -> str:
    body = "\n  ".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height:g}" width="{width}" '
        f'role="img">\n  <title>{escape(title)}</title>\n  <desc>{escape(about)}</desc>\n'
        f"  <style>{STYLE}\n  </style>\n"
        f'  <rect class="panel" x="1" y="1" width="{width - 2}" height="{height - 2:g}" rx="8"/>'
        f"\n  {body}\n</svg>\n"
    )


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

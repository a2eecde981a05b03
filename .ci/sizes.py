"""Print the size of every room beside its budget; exit 1 if one is above it.

    python3 .ci/sizes.py            # compare with .ci/sizes.toml
    python3 .ci/sizes.py --lower    # lower the budgets to today's numbers
    python3 .ci/sizes.py --names    # list the names that the last three numbers count

Lines are those of Python files that git tracks. Names are counted in all packages, tests apart:
vague names (variables, parameters and fields such as `given`) and starred calls (`f(*several)`)
per 1,000 lines, verbless functions (`of_people`, `claimed`) in percent of all functions. Tokens are
names, operators, numbers and strings of `ucfrec`, per line on which one begins: code that is only
squeezed together has fewer lines and more tokens in each. A budget is only ever lowered.
"""

import argparse
import ast
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUDGETS = ROOT / ".ci" / "sizes.toml"
PACKAGES = ("ucfrec", "datasets", "simulators", "control")
VAGUE = (
    "given found told said asked shown kept known own each many few others rest wanted lacking here"
    " there about like onto over before after begun listed read made used drawn tried named placed"
    " settled explained checked all_ one other"
)
PREPOSITIONS = "of in on with without by at near from as over to like onto under"
VERBS_IN_ED = {"need", "seed", "feed", "embed", "speed"}
NOUNS_ALLOWED = {"property", "cached_property", "classmethod", "fixture"}
"""Decorators of functions that may be called by a noun, or `from_…`."""
VAGUE_NAMES, FIRST_WORDS = set(VAGUE.split()), set(PREPOSITIONS.split())


def tracked_files() -> list[Path]:
    names = subprocess.run(
        ["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    return [Path(name) for name in names if (ROOT / name).exists()]


def count_lines(files: list[Path], rooms: str) -> int:
    """Lines of the files below any of the rooms: folders, or `folder/*.py` for its own files."""
    folders = rooms.split()
    return sum(
        (ROOT / file).read_text(encoding="utf-8").count("\n")
        for file in files
        if any(f"{file.parent}/*.py" == folder or file.is_relative_to(folder) for folder in folders)
    )


def scan_names(file: Path) -> Iterator[tuple[str, int, str]]:
    """(kind, line, name) of every function, vague name, verbless function and starred call."""
    for node in ast.walk(ast.parse((ROOT / file).read_text(encoding="utf-8"))):
        if (
            isinstance(node, ast.Name)
            and isinstance(node.ctx, ast.Store)
            and node.id in VAGUE_NAMES
        ):
            yield "vague", node.lineno, node.id
        elif isinstance(node, ast.arg) and node.arg in VAGUE_NAMES:
            yield "vague", node.lineno, node.arg
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield "function", node.lineno, node.name
            first = node.name.strip("_").split("_")[0]
            decorators = {getattr(d, "id", getattr(d, "attr", "")) for d in node.decorator_list}
            participle = first.endswith("ed") and first not in VERBS_IN_ED
            if not decorators & NOUNS_ALLOWED and (first in FIRST_WORDS or participle):
                yield "verbless", node.lineno, node.name
        elif isinstance(node, ast.Call) and any(isinstance(a, ast.Starred) for a in node.args):
            yield "starred", node.lineno, ast.unparse(node.func)


def measure_names(files: list[Path], show: bool) -> dict[str, float]:
    sources = [file for file in files if file.parts[0] in PACKAGES]
    lines = count_lines(files, " ".join(PACKAGES))
    counts = dict.fromkeys(("function", "vague", "verbless", "starred"), 0)
    for file in sources:
        for kind, line, name in scan_names(file):
            counts[kind] += 1
            if show and kind != "function":
                print(f"{file}:{line} {kind} {name}")
    return {
        "vague names per 1,000 lines": round(1000 * counts["vague"] / lines, 1),
        "verbless functions in percent": round(100 * counts["verbless"] / counts["function"], 1),
        "starred calls per 1,000 lines": round(1000 * counts["starred"] / lines, 1),
    }


def measure_density(files: list[Path]) -> dict[str, float]:
    """Tokens per line of code, and how many lines in 1,000 have 30 or more."""
    # From Python 3.12 on, an f-string is several tokens; it counts as one, as before.
    begin, end = (getattr(tokenize, f"FSTRING_{part}", -1) for part in ("START", "END"))
    kinds = {tokenize.NAME, tokenize.OP, tokenize.NUMBER, tokenize.STRING, begin}
    counts: Counter[tuple[Path, int]] = Counter()
    for file in files:
        if file.parts[0] != "ucfrec":
            continue
        with tokenize.open(ROOT / file) as source:
            depth = 0
            for token in tokenize.generate_tokens(source.readline):
                if not depth and token.type in kinds:
                    counts[file, token.start[0]] += 1
                depth += (token.type == begin) - (token.type == end)
    dense = sum(count >= 30 for count in counts.values())
    return {
        "tokens per line of code": round(sum(counts.values()) / len(counts), 2),
        "lines of 30 or more tokens per 1,000": round(1000 * dense / len(counts), 1),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--lower", action="store_true", help="lower the budgets to today's numbers")
    parser.add_argument("--names", action="store_true", help="list the names that are counted")
    options = parser.parse_args()
    text = BUDGETS.read_text(encoding="utf-8")
    tables = tomllib.loads(text)
    files = tracked_files()
    sizes: dict[str, dict[str, float]] = {
        "lines": {rooms: count_lines(files, rooms) for rooms in tables["lines"]},
        "names": measure_names(files, options.names),
        "tokens": measure_density(files),
    }
    width = max(len(key) for table in sizes.values() for key in table)
    above = 0
    for table, values in sizes.items():
        print(f"{table:{width}}  {'now':>8}  {'budget':>8}")
        for key, value in values.items():
            budget = tables[table][key]
            above += value > budget
            print(f"{key:{width}}  {value:8,}  {budget:8,}{'  ABOVE' if value > budget else ''}")
            if options.lower and value < budget:
                text = text.replace(f'"{key}" = {budget}\n', f'"{key}" = {value}\n')
    if options.lower:
        BUDGETS.write_text(text, encoding="utf-8")
    if above:
        print(f"{above} above budget: shrink the room; budgets are never raised")
    return 1 if above else 0


if __name__ == "__main__":
    sys.exit(main())

"""Style of all figures: a color-blind-safe palette and the column widths of a paper.

Matplotlib is imported only when a figure is drawn.
"""

import re
from collections.abc import Callable, Iterable
from functools import wraps
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, ParamSpec, TypeVar

from ucfrec.files.atomic import atomic_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

P = ParamSpec("P")
Drawn = TypeVar("Drawn")

COLUMN, PAGE = 3.4, 7.0
"""Widths of one column and of the whole page, in inches."""
FACTUAL, EDITED = "#0072B2", "#D55E00"
PLAIN, OURS, LIGHT = "#8C8C8C", "#D55E00", "#56B4E9"
"""Colors of other methods, of UCF, and of a third bar."""
MAP = "cividis"
_NOT_IN_NAMES: Final = re.compile(r"[^\w,.= -]+")
# The color-blind-safe palette of Okabe and Ito (2008).
_PALETTE = (
    *("#0072B2", "#E69F00", "#009E73", "#D55E00"),
    *("#CC79A7", "#56B4E9", "#000000", "#8C8C8C"),
)
# A method or condition has the same color in all figures.
_FIXED = {
    "bc": "#8C8C8C",
    "dt": "#0072B2",
    "dc": "#56B4E9",
    "lsdt": "#009E73",
    "ucf": "#D55E00",
    "ucf-screened": "#CC79A7",
    "ucf-dropped": "#F0E442",
    "ucf-wo-count": "#E69F00",
    "ucf-no-augmentation": "#E69F00",
    "ucf-wo-arch": "#000000",
    "dt-augmented": "#000000",
    "none": "#8C8C8C",
    "deterministic": "#0072B2",
    "stochastic": "#56B4E9",
    "early": "#E69F00",
}
_LABELS = {
    "bc": "BC",
    "dt": "DT",
    "dc": "DC",
    "lsdt": "LSDT",
    "ucf": "UCF",
    "ucf-screened": "UCF, screened",
    "ucf-dropped": "UCF, dropped",
    "ucf-wo-count": "w/o Count",
    "ucf-no-augmentation": "w/o Count",
    "ucf-wo-arch": "w/o Arch",
    "dt-augmented": "w/o Arch",
    "none": "no distractor",
}

_RC: Final[Any] = {
    "figure.dpi": 200,
    "figure.constrained_layout.use": True,
    "font.size": 8,
    "axes.titlesize": 8,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "#DDDDDD",
    "lines.linewidth": 1.3,
    "lines.markersize": 3.5,
    "image.cmap": MAP,
    # Text stays text in SVG, and equal figures give identical files.
    "svg.fonttype": "none",
    "svg.hashsalt": "ucfrec",
}


def styled(draw: Callable[P, Drawn]) -> Callable[P, Drawn]:
    """Decorator for functions that draw or save a figure: applies the style."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Drawn:
        from matplotlib import rc_context

        with rc_context(_RC):
            return draw(*args, **kwargs)

    return drawn


def label(name: str) -> str:
    """Display name of a method or condition in figures."""
    return _LABELS.get(name, name)


def colors(names: Iterable[str]) -> dict[str, str]:
    """Name to color: the fixed color of the name, else an unused color of the palette."""
    listed = list(names)
    taken = {_FIXED.get(name) for name in listed}
    free = cycle([color for color in _PALETTE if color not in taken] or _PALETTE)
    return {name: _FIXED.get(name) or next(free) for name in listed}


@styled
def save(figure: "Figure", folder: Path, name: str) -> list[Path]:
    """Write `figure` as `name.png` and `name.svg` in `folder`, atomically; returns both paths.

    Of the name, which may be a dataset's, characters that a path gives a meaning become "-".
    """
    files = []
    for kind in ("png", "svg"):
        path = folder / f"{_NOT_IN_NAMES.sub('-', name)}.{kind}"
        with atomic_file(path) as scratch:
            # A date in the metadata would make the SVG files of equal figures differ.
            metadata = {"Date": None} if kind == "svg" else None
            figure.savefig(scratch, format=kind, metadata=metadata)
        files.append(path)
    return files

"""Style of figures that are files: colors and the column widths of a paper.

Matplotlib is imported only when a figure is drawn.
"""

import re
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, ParamSpec, TypeVar

from ucfrec.files.atomic import atomic_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

P = ParamSpec("P")
Drawn = TypeVar("Drawn")

COLUMN, PAGE = 3.4, 7.0
"""Widths of one column and of the whole page, in inches."""
PLAIN, OURS, LIGHT = "#8C8C8C", "#D55E00", "#56B4E9"
"""Colors of other methods, of UCF, and of a third bar."""
_NOT_IN_NAMES: Final = re.compile(r"[^\w,.= -]+")

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
    "image.cmap": "cividis",
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

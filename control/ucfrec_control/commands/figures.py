"""`ucfrec-control figures`: figures of runs and result rows."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from ucfrec.commands.options import Table
from ucfrec.errors import InputError


class Figures(Table):
    """`ucfrec-control figures`."""

    runs: Annotated[Sequence[Path], "RUN"] = ()
    """Run, or folder of runs; repeatable."""
    results: Annotated[Sequence[Path], "ROWS"] = ()
    """File of result rows; repeatable."""
    out: Path
    """Folder of the figures."""

    def execute(self) -> None:
        """Run `ucfrec-control figures`. InputError without runs and rows."""
        if not (self.runs or self.results):
            raise InputError("name runs with --runs, or files of rows with --results")
        # matplotlib takes half a second to import
        from ucfrec_control.figures.figures import make_figures

        files, missing = make_figures(self.runs, self.results, self.out)
        print("\n".join(map(str, files)))
        for line in missing:
            print(f"missing: {line}", file=sys.stderr)

"""`ucfrec-control export`: a policy as an ONNX graph of the window of its history."""

from pathlib import Path
from typing import Annotated, Literal

from ucfrec.commands.options import ARGUMENT, Table
from ucfrec_control.training.export import export_run


class Export(Table):
    """`ucfrec-control export`."""

    run: Annotated[Path, ARGUMENT]
    """Run folder."""
    out: Path
    """Folder of model.onnx and model.json."""
    checkpoint: Literal["last", "best", "return"] = "last"
    """Weights to export."""

    def execute(self) -> None:
        """Run `ucfrec-control export`."""
        difference = export_run(self.run, self.out, self.checkpoint)
        print(f"graph: {self.out}; its actions differ from torch's by at most {difference:.1g}")

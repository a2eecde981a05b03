"""MkDocs hook: the executed notebooks of `examples/` become the pages `tutorials/NAME.md`.

python docs/notebooks.py [NAME ...]    # execute notebooks and write their outputs into them
"""

import base64
import json
import os
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
NOTEBOOKS = ("shop", "evaluation", "control")
PICTURES = {"image/svg+xml": "svg", "image/png": "png"}


def page(name: str) -> tuple[str, dict[str, bytes]]:
    """Markdown of a notebook, and its pictures by file name."""
    text = (ROOT / "examples" / f"{name}.ipynb").read_text(encoding="utf-8")
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
        elif cell["cell_type"] == "code":
            parts.append(f"```python\n{source}\n```")
            for output in cell["outputs"]:
                parts.extend(_output(output, f"{name}-{len(pictures)}", pictures))
    parts.append(f"This page is the notebook `examples/{name}.ipynb`, executed by the tests.")
    return "\n\n".join(parts) + "\n", pictures


def _output(output: dict[str, Any], name: str, pictures: dict[str, bytes]) -> list[str]:
    """Text or a picture; nothing of stderr, where progress is printed."""
    if output["output_type"] == "stream":
        text = "".join(output["text"]) if output["name"] == "stdout" else ""
        return [f"```text\n{text.rstrip()}\n```"] if text.strip() else []
    data = output.get("data", {})
    for kind, suffix in PICTURES.items():
        if kind in data:
            content = "".join(data[kind])
            file = f"{name}.{suffix}"
            pictures[file] = content.encode() if suffix == "svg" else base64.b64decode(content)
            title = "".join(data.get("text/plain", "")).strip("<>") or "figure"
            return [f"![{title}]({file})"]
    text = "".join(data.get("text/plain", ""))
    return [f"```text\n{text}\n```"] if text else []


def on_files(files: Any, config: Any) -> Any:
    """Add the pages; called by MkDocs."""
    from mkdocs.structure.files import File

    for name in NOTEBOOKS:
        text, pictures = page(name)
        files.append(File.generated(config, f"tutorials/{name}.md", content=text))
        for file, content in pictures.items():
            files.append(File.generated(config, f"tutorials/{file}", content=content))
    return files


def execute(name: str) -> None:
    """Execute a notebook with this Python, and keep its outputs but for what goes to stderr."""
    import nbformat
    from nbclient import NotebookClient

    path = ROOT / "examples" / f"{name}.ipynb"
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(
        notebook,
        timeout=1800,
        kernel_name="python3",
        coalesce_streams=True,
        resources={"metadata": {"path": str(path.parent)}},
    ).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = [each for each in cell.outputs if each.get("name") != "stderr"]
    nbformat.write(notebook, path)


if __name__ == "__main__":
    # The commands of the notebooks are those of this Python.
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for chosen in sys.argv[1:] or NOTEBOOKS:
        execute(chosen)

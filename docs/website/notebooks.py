"""Notebooks as pages: their text, their code, and what they show if they are run."""

import base64
import json
import os
import tempfile
from pathlib import Path, PurePosixPath
from typing import Any


def read(path: Path) -> dict[str, Any]:
    """A notebook as it is stored, without outputs."""
    return json.loads(path.read_text(encoding="utf-8"))


def run(path: Path) -> dict[str, Any]:
    """A notebook with the outputs of a run at full size."""
    # The site is built without them too.
    import nbformat
    from nbclient import NotebookClient

    print(f"running {path.name}")
    notebook = nbformat.read(path, as_version=4)
    for name in ("NHJAX_SMALL", "MPLBACKEND"):
        os.environ.pop(name, None)
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        NotebookClient(notebook, timeout=1200, resources=resources).execute()
    return json.loads(nbformat.writes(notebook))


def page(notebook: dict[str, Any], source: str) -> tuple[str, dict[str, bytes]]:
    """The page of a notebook, and its pictures by the names of their files."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        is_text = cell["cell_type"] == "markdown"
        parts.append(text if is_text else f"```python\n{text}\n```")
        printed = ""
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            shown = output.get("text") or data.get("text/plain")
            if "image/png" in data:
                name = f"{PurePosixPath(source).stem}-{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode(data["image/png"])
                parts.append(f"![Picture {len(pictures)}]({name})")
            elif shown and output.get("name") != "stderr":
                printed += "".join(shown).rstrip() + "\n"
        if printed:
            parts.append(f"```text\n{printed}```")
    title, *others = parts
    where = f"*The notebook is `{source}` in the repository.*"
    return "\n\n".join([title, where, *others]) + "\n", pictures

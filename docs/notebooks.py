"""The outputs of the notebooks, and the page that shows all notebooks.

    python -m docs.notebooks               runs all notebooks, about 15 minutes
    python -m docs.notebooks cvt bicycle   runs these
    python -m docs.notebooks --text        only writes docs/notebooks.md

Each notebook runs at full size, and is stored with its outputs. Its first figure is
stored as docs/notebooks/NAME.png. Text can be edited without another run; a test fails
if a cell of code was edited and the notebook was not run again.
"""

import argparse
import base64
import hashlib
import io
import json
import os
import tempfile
import textwrap
import time
from pathlib import Path
from typing import Any

from PIL import Image


DOCS = Path(__file__).parent
FOLDER = DOCS.parent / "notebooks"
THUMBNAILS = DOCS / "notebooks"
LARGEST_FIGURE = 60_000  # bytes
LARGEST_THUMBNAIL = 30_000  # bytes
# In the order of the page and of the site.
GROUPS = {
    "First steps": ("quickstart", "own_machine"),
    "Accuracy and long runs": (
        "orders_and_closures",
        "cvt",
        "chaotic_ensemble",
        "ensemble",
    ),
    "Rotations and rolling": ("lie_groups", "bicycle", "rattleback"),
    "Fitting, learning and control": (
        "fitting",
        "learning_potential",
        "steering_unicycle",
    ),
}
OPENING = """# Notebooks

Each notebook answers one question with nhjax, from the model to the figures. The pages
show the code with the output of a run at full size. The files are in `notebooks/`; with
`pip install ".[notebooks,xarray,ensemble]" jupyterlab` they run in a browser.
`NHJAX_SMALL=1` in the environment makes the runs shorter.
"""


def read(name: str) -> dict[str, Any]:
    """Read a notebook."""
    return json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))


def source(cell: dict[str, Any]) -> str:
    """Return the text of a cell."""
    return "".join(cell["source"])


def code_hash(notebook: dict[str, Any]) -> str:
    """Return a hash of the cells of code, in hexadecimal digits."""
    cells = [source(x) for x in notebook["cells"] if x["cell_type"] == "code"]
    return hashlib.sha256(json.dumps(cells).encode()).hexdigest()[:16]


def figures(notebook: dict[str, Any]) -> list[bytes]:
    """Return the pictures in the outputs, as PNG."""
    return [
        base64.b64decode("".join(output["data"]["image/png"]))
        for cell in notebook["cells"]
        for output in cell.get("outputs", [])
        if "image/png" in output.get("data", {})
    ]


def run(name: str) -> None:
    """Run a notebook at full size, and store it with its outputs."""
    # The page can be written without these packages.
    import nbformat
    from nbclient import NotebookClient

    notebook: Any = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    for variable in ("NHJAX_SMALL", "MPLBACKEND"):
        os.environ.pop(variable, None)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(
            notebook,
            timeout=1800,
            record_timing=False,
            resources={"metadata": {"path": folder}},
        ).execute()
    # The text may have been edited during the run.
    stored: Any = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    if code_hash(stored) != code_hash(notebook):
        raise RuntimeError(f"The code of {name} was edited during the run.")
    ran = (cell for cell in notebook.cells if cell.cell_type == "code")
    for count, cell in enumerate((x for x in stored.cells if x.cell_type == "code"), 1):
        cell.outputs = _kept(next(ran).outputs)
        cell.execution_count = count
        for output in cell.outputs:
            if output.output_type == "execute_result":
                output.execution_count = count
    stored.metadata = {
        "kernelspec": {
            "display_name": "Python 3",
            "language": "python",
            "name": "python3",
        },
        "language_info": {"name": "python"},
        "nhjax": {"code": code_hash(stored)},
    }
    nbformat.write(stored, FOLDER / f"{name}.ipynb")
    (THUMBNAILS / f"{name}.png").write_bytes(_thumbnail(figures(read(name))[0]))


def _kept(outputs: list[Any]) -> list[Any]:
    """Return printed text and figures, in forms that do not change between runs."""
    kept = []
    for output in outputs:
        if output.get("name") == "stderr":
            continue
        if "data" in output:
            # HTML tables contain random names, and figures the address of an object.
            data = output.data
            if "image/png" in data:
                output.data = {"image/png": _compressed(data["image/png"])}
            else:
                output.data = {"text/plain": data["text/plain"]}
            output.metadata = {}
        last: Any = kept[-1] if kept else {}
        if output.get("name") == "stdout" and last.get("name") == "stdout":
            last.text += output.text
        else:
            kept.append(output)
    return kept


def _compressed(data: str) -> str:
    """Return a PNG with a palette and without metadata."""
    picture = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")
    return base64.b64encode(_with_palette(picture, LARGEST_FIGURE)).decode()


def _with_palette(picture: Image.Image, largest: int) -> bytes:
    """Return a PNG of at most `largest` bytes, with as many colours as possible."""
    for colours in (256, 64, 48, 32, 16):
        file = io.BytesIO()
        fewer = picture.quantize(colours, dither=Image.Dither.NONE)
        fewer.save(file, format="png", optimize=True)
        if file.tell() <= largest:
            return file.getvalue()
    raise ValueError(f"A figure has more than {largest} bytes with 16 colours.")


def _thumbnail(figure: bytes) -> bytes:
    """Return a smaller picture, of the same size for all notebooks."""
    picture = Image.open(io.BytesIO(figure)).convert("RGB")
    picture.thumbnail((480, 300), Image.Resampling.LANCZOS)
    canvas = Image.new("RGB", (480, 300), "white")
    canvas.paste(picture, ((480 - picture.width) // 2, (300 - picture.height) // 2))
    return _with_palette(canvas, LARGEST_THUMBNAIL)


def page() -> str:
    """Return the text of docs/notebooks.md."""
    parts = [OPENING]
    for group, names in GROUPS.items():
        parts.append(f'## {group}\n\n<div class="grid cards" markdown>\n')
        for name in names:
            title, text = source(read(name)["cells"][0]).split("\n\n")[:2]
            title = title.removeprefix("# ")
            link = f"../notebooks/{name}.ipynb"
            sentence = " ".join(text.split()).split(". ")[0].rstrip(".") + "."
            indented = textwrap.indent(textwrap.fill(sentence, 84), "    ")
            parts.append(
                f"- [![The first figure of {title}](notebooks/{name}.png)]({link})\n\n"
                f"    [{title}]({link})\n\n{indented}\n"
            )
        parts.append("</div>\n")
    return "\n".join(parts)


def main() -> None:
    """Run the notebooks and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    everything = [name for names in GROUPS.values() for name in names]
    parser.add_argument("names", nargs="*", metavar="NAME", help="run only these")
    parser.add_argument("--text", action="store_true", help="only write the page")
    options = parser.parse_args()
    if unknown := set(options.names) - set(everything):
        parser.error(f"no such notebook: {', '.join(sorted(unknown))}")
    THUMBNAILS.mkdir(exist_ok=True)
    for name in [] if options.text else options.names or everything:
        start = time.perf_counter()
        run(name)
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    (DOCS / "notebooks.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()

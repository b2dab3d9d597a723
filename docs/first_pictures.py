"""Runs the code that makes the pictures of README and of docs/start.md.

`python docs/first_pictures.py` writes docs/blade.png and docs/car.gif.
"""

import contextlib
import re
from pathlib import Path

import matplotlib


DOCS = Path(__file__).parent


def main() -> None:
    """Run the first block of Python of each page in the folder of the pictures."""
    matplotlib.use("Agg")
    with contextlib.chdir(DOCS):
        for page in (DOCS.parent / "README.md", DOCS / "start.md"):
            text = page.read_text(encoding="utf-8")
            block = re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S)[0]
            exec(compile(block, page.name, "exec"), {})


if __name__ == "__main__":
    main()

"""Run every feature as users do, with annotations of shapes checked.

Run `python -m support.with_shapes` in `tests`.
"""

import runpy

from jaxtyping import install_import_hook

from support import shapes


if __name__ == "__main__":
    # This must precede every import of nhjax.
    with install_import_hook(shapes.rooms_with_shapes(), "support.shapes.checked"):
        runpy.run_module("support.as_users_run", run_name="__main__")

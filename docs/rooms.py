"""The rooms of nhjax, the imports between them, and the size of the repository.

- `python docs/rooms.py` draws docs/rooms.png and writes docs/rooms.md.
- `python docs/rooms.py --measure [--json] [--tree PATH]` measures this checkout, or
    another one, and prints the figures.
- `python docs/rooms.py --measure --record NAME` also stores them under a name in
    docs/rooms.json, and writes docs/rooms.md, whose last table has a column for each
    name.

`tests/test_rooms.py` uses the same functions to check that no arrow points up.
"""

import argparse
import ast
import importlib
import json
import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from matplotlib.path import Path as MplPath


DOCS = Path(__file__).parent
PACKAGE = DOCS.parent / "nhjax"

# The lowest floor comes first. A room may import from rooms to its left on its floor.
FLOORS = (
    ("_custom_types", "_errors", "_results"),
    ("lanes",),
    ("_compile",),
    ("_method",),
    ("_numerics",),
    ("_manifold",),
    ("_system",),
    ("_initial",),
    ("_analysis",),
    ("_models",),
    ("_step",),
    ("_integrate",),
    ("_io",),
    ("_ensemble",),
    ("forces", "rolling"),
    ("_robots",),
    ("friction", "systems", "diagnostics", "plot", "_films", "studies", "__main__"),
)
ROOMS = tuple(room for floor in FLOORS for room in floor)


class Import(NamedTuple):
    """An import of one module of the package by another, with its line."""

    importer: str
    imported: str
    line: int


def read_sources(package: Path = PACKAGE) -> dict[str, str]:
    """The text of each module, by its dotted name inside the package.

    A folder has its own name, and the package itself the name "".
    """
    sources = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package).with_suffix("").parts
        if parts[-1] == "__init__":
            parts = parts[:-1]
        sources[".".join(parts)] = path.read_text(encoding="utf-8")
    return sources


def read_imports(sources: Mapping[str, str], name: str = "nhjax") -> list[Import]:
    """Every import between modules of the package, also inside functions."""
    folders = {module.rpartition(".")[0] for module in sources} | {""}
    found = []
    for module, text in sources.items():
        here = module.split(".") if module else []
        if module not in folders and here:
            here = here[:-1]
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.Import | ast.ImportFrom):
                continue
            for target in _targets(node, here, name):
                imported = _module_of(target, sources)
                if imported is not None and imported != module:
                    found.append(Import(module, imported, node.lineno))
    return found


def _targets(
    node: ast.Import | ast.ImportFrom, here: list[str], name: str
) -> Iterator[list[str]]:
    """The names that a statement imports, as paths from the top of the package."""
    if isinstance(node, ast.Import):
        for alias in node.names:
            parts = alias.name.split(".")
            if parts[0] == name:
                yield parts[1:]
    else:
        base = node.module.split(".") if node.module else []
        if node.level:
            base = here[: len(here) - node.level + 1] + base
        elif base[:1] == [name]:
            base = base[1:]
        else:
            return
        for alias in node.names:
            yield [*base, alias.name]


def _module_of(target: list[str], sources: Mapping[str, str]) -> str | None:
    """The module at the start of a path; the rest of the path is a name inside it."""
    for length in range(len(target), -1, -1):
        module = ".".join(target[:length])
        if module in sources:
            return module
    return None


def room(module: str) -> str:
    """The room that a module is in; "" for the package itself."""
    return module.split(".")[0]


def between_rooms(imports: Iterable[Import]) -> list[Import]:
    """The imports that lead from one room to another.

    The package's own `__init__`, which collects the public names, is not a room. It is
    above all rooms except the command line.
    """
    return [
        found
        for found in imports
        if room(found.importer) and room(found.importer) != room(found.imported)
        if (room(found.importer), found.imported) != ("__main__", "")
    ]


def upward(imports: Iterable[Import], rooms: tuple[str, ...] = ROOMS) -> list[Import]:
    """The imports between rooms that do not point down."""

    def height(module: str) -> int:
        return rooms.index(room(module)) if room(module) else len(rooms)

    return [
        found
        for found in between_rooms(imports)
        if height(found.imported) >= height(found.importer)
    ]


def circle(arrows: Iterable[tuple[str, str]]) -> list[str] | None:
    """Names that import each other in a circle, or None if there is none."""
    leads_to: dict[str, set[str]] = {}
    for start, end in arrows:
        leads_to.setdefault(start, set()).add(end)
    done: set[str] = set()

    def search(name: str, path: list[str]) -> list[str] | None:
        if name in path:
            return [*path[path.index(name) :], name]
        if name in done:
            return None
        for end in sorted(leads_to.get(name, ())):
            found = search(end, [*path, name])
            if found:
                return found
        done.add(name)
        return None

    for name in sorted(leads_to):
        found = search(name, [])
        if found:
            return found
    return None


def num_files(modules: Iterable[str], folder: str) -> int:
    """The number of files of a room, including rooms inside it."""
    return sum(name == folder or name.startswith(f"{folder}.") for name in modules)


def num_floors(imports: Iterable[Import], folder: str) -> int:
    """The longest chain of imports inside a folder, without its `__init__`."""
    leads_to: dict[str, set[str]] = {}
    for found in imports:
        if all(x.rpartition(".")[0] == folder for x in found[:2]):
            leads_to.setdefault(found.importer, set()).add(found.imported)

    def height(module: str) -> int:
        return 1 + max(map(height, leads_to.get(module, ())), default=0)

    return max(map(height, leads_to), default=1)


def folders(sources: Mapping[str, str]) -> list[str]:
    """The rooms that are folders, with the folders inside them."""
    return sorted({module.rpartition(".")[0] for module in sources} - {""})


def count(folder: Path, without: Path | None = None) -> tuple[int, int]:
    """The numbers of Python files below a folder, and of their lines.

    Files below `without` are not counted.
    """
    paths = [
        path
        for path in folder.rglob("*.py")
        if without is None or not path.is_relative_to(without)
    ]
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)
    return len(paths), lines


# The function that repeats a sweep until it converges. If it is on the stack, the
# Lagrangian is evaluated inside the stage iteration.
ITERATION = "iterate"


class Stack(NamedTuple):
    """The frames of nhjax from `integrate` to one evaluation of the Lagrangian.

    Each frame is a pair of a file, relative to the package, and a function.
    """

    frames: tuple[tuple[str, str], ...]

    @property
    def num_files(self) -> int:
        """The number of different files."""
        return len({file for file, _ in self.frames})

    def passes(self, function: str) -> bool:
        """Whether a function with this name is among the frames."""
        return any(name == function for _, name in self.frames)


def stacks(nhjax: Any, transformation: str) -> list[Stack]:
    """The stack at each evaluation of the Lagrangian of one call of `integrate`.

    The Lagrangian is traced once, to one operation; each derivative is one operation
    too. The Lagrangian contains an arctangent, which identifies these operations. The
    stack is recorded whenever one of them is bound, without the frames of other
    packages.

    **Arguments:**

    - `nhjax`: the package.
    - `transformation`: `"plain"`, `"vmap"` or `"grad"`.
    """
    package, found = Path(nhjax.__file__).parent, []
    operation = importlib.import_module("nhjax._numerics._kept").kept_call
    bind = operation.bind

    def recorded(*args, **params):
        if "atan2" in str(params["jaxpr"]):
            found.append([frame for frame, _ in traceback.walk_stack(None)][::-1])
        return bind(*args, **params)

    def lagrangian(t, q, v, args):
        return 0.5 * v @ v - 0.5 * args * q @ q - jnp.arctan2(q[0], 3.0)

    system = nhjax.LagrangianSystem(
        lagrangian, nonholonomic=lambda t, q, v, args: v[2] - q[1] * v[0]
    )
    q, v = jnp.array([1.0, 1.0, 0.0]), jnp.array([1.0, 0.0, 1.0])
    start = nhjax.initial_state(system, q, v, args=1.0)

    def end(args):
        method = nhjax.LobattoIIIAB(2)
        run = nhjax.integrate(system, method, start, dt=0.1, num_steps=3, args=args)
        return run.ys.q[-1, 0]

    calls = {
        "plain": lambda: end(1.0),
        "vmap": lambda: jax.vmap(end)(jnp.ones(3)),
        "grad": lambda: jax.grad(end)(1.0),
    }
    operation.bind = recorded
    try:
        calls[transformation]()
    finally:
        del operation.bind
    chosen = []
    for stack in found:
        inside = [
            (Path(frame.f_code.co_filename), frame.f_code.co_name) for frame in stack
        ]
        frames = [
            (path.relative_to(package).as_posix(), name)
            for path, name in inside
            if path.is_relative_to(package)
        ]
        names = [name for _, name in frames]
        if "integrate" in names:
            chosen.append(Stack(tuple(frames[names.index("integrate") :])))
    return chosen


def deepest(found: Iterable[Stack]) -> Stack:
    """The stack with the most frames; among equals, the stack with the most files."""
    return max(found, key=lambda stack: (len(stack.frames), stack.num_files))


def deepest_stacks(nhjax: Any) -> dict[str, Stack]:
    """The deepest evaluations of the Lagrangian, by the transformation of the call.

    - `plain`, `vmap`, `grad`: the deepest evaluation inside the stage iteration.
    - `grad, derivative`: the deepest evaluation that only the derivative of the run
        makes.
    """
    by_call = {name: stacks(nhjax, name) for name in ("plain", "vmap", "grad")}
    result = {
        name: deepest(stack for stack in found if stack.passes(ITERATION))
        for name, found in by_call.items()
    }
    others = set(by_call["grad"]) - set(by_call["plain"])
    result["grad, derivative"] = deepest(others)
    return result


def measured(tree: Path, found: Mapping[str, Stack]) -> dict[str, int | str]:
    """The figures of a checkout, with the stacks found in it."""
    package = tree / "nhjax"
    sources = read_sources(package)
    imports = read_imports(sources)
    between = between_rooms(imports)
    arrows = {(room(one.importer), room(one.imported)) for one in between}
    floors = {name: num_floors(imports, name) for name in folders(sources)}
    parts = {
        "nhjax": count(package),
        "nhjax without the gallery": count(package, package / "systems"),
        "tests": count(tree / "tests"),
        "benchmarks": count(tree / "benchmarks"),
        "docs/website": count(tree / "docs" / "website"),
    }
    figures: dict[str, int | str] = {}
    for name, (num_files, num_lines) in parts.items():
        figures[f"files, {name}"] = num_files
        figures[f"lines, {name}"] = num_lines
    figures["arrows between rooms"] = len(arrows)
    figures["floors of the deepest room"] = max(floors.values())
    for name, floor in floors.items():
        figures[f"floors, {name.replace('.', '/')}"] = floor
    for name, stack in found.items():
        figures[f"frames, {name}"] = len(stack.frames)
        figures[f"files of the frames, {name}"] = stack.num_files
    return figures


def table(columns: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The lines of a table with a column for each set of figures."""
    rows = list(dict.fromkeys(row for column in columns.values() for row in column))
    lines = [f"| | {' | '.join(columns)} |", f"| --- |{' ---: |' * len(columns)}"]
    for row in sorted(rows, key=lambda row: row.startswith("floors, ")):
        cells = [str(column.get(row, "-")) for column in columns.values()]
        lines.append(f"| {row} | {' | '.join(cells)} |")
    return lines


def recorded_figures() -> dict[str, dict[str, int | str]]:
    """The figures that were recorded, by the name of their checkout."""
    return json.loads((DOCS / "rooms.json").read_text(encoding="utf-8"))


def purpose(source: str) -> str:
    """The first paragraph of a module's docstring, on one line."""
    text = ast.get_docstring(ast.parse(source)) or ""
    return " ".join(text.split("\n\n")[0].split())


def page(sources: Mapping[str, str]) -> str:
    """The text of docs/rooms.md."""
    imports = read_imports(sources)
    arrows = {
        (room(found.importer), room(found.imported)) for found in between_rooms(imports)
    }
    lines = [
        "# The rooms",
        "",
        "The package consists of rooms. A room is a folder or a file of the package",
        "with one purpose. A room imports only from the rooms that are below it in",
        "the picture. From a room that is a folder, it imports only the names in",
        "`__init__` of this folder. `tests/test_rooms.py` reads the imports and fails",
        "if a room imports from a room above it. `python docs/rooms.py` draws the",
        "picture from the imports and writes this page. An arrow leads from a room to",
        "a room from which it imports; arrows to the three rooms at the bottom are",
        "grey.",
        "",
        "![The rooms of nhjax and their imports](rooms.png)",
        "",
        'The table lists the rooms from top to bottom. The column "floors" is the',
        "number of files in the longest chain of imports inside the room:",
        "",
        "| room | purpose | imports from | files | floors |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name in reversed(ROOMS):
        below = [f"`{other}`" for other in ROOMS if (name, other) in arrows]
        cells = [f"`{name}`", purpose(sources[name]), ", ".join(below)]
        cells += [str(num_files(sources, name)), str(num_floors(imports, name))]
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        "## Before and after",
        "",
        "`python docs/rooms.py --measure` measures a checkout of the repository: its",
        "Python files and their lines, the arrows between rooms, the floors inside",
        "each folder, and the depth of the Lagrangian below `integrate`. The depth is",
        "read from real tracebacks. It is the number of stack frames of nhjax from",
        "the call of `integrate` to the deepest evaluation of the Lagrangian in the",
        "iteration of a step. The rows `grad, derivative` count the frames to the",
        "deepest evaluation that only the derivative of the run makes.",
        "[One call, followed](one_call.md) explains the frames. The columns `before`",
        "and `after` show a reorganisation that joined small files. Between `after`",
        "and `now`, nhjax gained rolling contacts, friction, robots, films, steps",
        "that adapt, and user functions that are traced once for all uses.",
        "",
        *table(recorded_figures()),
    ]
    return "\n".join(lines) + "\n"


def draw(sources: Mapping[str, str]) -> Figure:
    """The picture of the rooms, each on its own level, with arrows that point down."""
    figure = Figure(figsize=(9, 10), layout="constrained")
    ax = figure.subplots()
    box = {"boxstyle": "round,pad=0.4", "facecolor": "#eef3f8", "edgecolor": "#4a6a8a"}
    for name, (x, y) in _PLACES.items():
        ax.text(
            x, y, name, ha="center", va="center", family="monospace", bbox=box, zorder=3
        )
    arrows = {
        (room(found.importer), room(found.imported))
        for found in between_rooms(read_imports(sources))
    }
    for start, end in sorted(arrows):
        _arrow(ax, _PLACES[start], _PLACES[end], light=end in FLOORS[0])
    ax.set_xlim(-0.6, 4.6)
    ax.set_ylim(-0.6, len(ROOMS) - 0.4)
    ax.axis("off")
    return figure


# Columns in which few arrows pass behind a room.
_COLUMNS = {
    "_custom_types": 1.2,
    "_errors": 2.8,
    "_results": 3.6,
    "lanes": 0.4,
    "_compile": 0.4,
    "_method": 4.0,
    "_numerics": 0.9,
    "_manifold": 1.9,
    "_system": 1.4,
    "_initial": 0.9,
    "_analysis": 0.2,
    "_models": 1.3,
    "_step": 2.4,
    "_integrate": 3.0,
    "_io": 4.1,
    "_ensemble": 3.5,
    "forces": 0.7,
    "rolling": 1.2,
    "_robots": 2.0,
    "friction": 0.8,
    "systems": 0.0,
    "diagnostics": 1.8,
    "plot": 2.5,
    "_films": 0.9,
    "studies": 3.3,
    "__main__": 4.0,
}
_PLACES = {name: (_COLUMNS[name], height) for height, name in enumerate(ROOMS)}


def _arrow(
    ax: Axes, start: tuple[float, float], end: tuple[float, float], *, light: bool
) -> None:
    """A curve from the bottom of a room to the top of another."""
    (x0, y0), (x1, y1) = (start[0], start[1] - 0.24), (end[0], end[1] + 0.26)
    pull = 0.45 * (y0 - y1)
    path = MplPath(
        [(x0, y0), (x0, y0 - pull), (x1, y1 + pull), (x1, y1)],
        [MplPath.MOVETO, MplPath.CURVE4, MplPath.CURVE4, MplPath.CURVE4],
    )
    ax.add_patch(
        FancyArrowPatch(
            path=path,
            arrowstyle="-|>",
            mutation_scale=9,
            color="#b0b8c0" if light else "#4a6a8a",
            linewidth=0.7 if light else 1.0,
            zorder=1 if light else 2,
        )
    )


def main() -> None:
    """Write the picture and the page, or measure a checkout."""
    parser = argparse.ArgumentParser(description="Draw or measure the rooms of nhjax.")
    parser.add_argument("--measure", action="store_true", help="print the figures")
    parser.add_argument("--json", action="store_true", help="print them as JSON")
    parser.add_argument("--stacks", action="store_true", help="print the frames too")
    parser.add_argument("--tree", type=Path, default=DOCS.parent, help="the checkout")
    parser.add_argument("--record", metavar="NAME", help="store the figures")
    given = parser.parse_args()
    if given.measure:
        _measure(given)
    if not given.measure or given.record:
        sources = read_sources()
        draw(sources).savefig(DOCS / "rooms.png", dpi=80)
        (DOCS / "rooms.md").write_text(page(sources), encoding="utf-8")


def _measure(given: argparse.Namespace) -> None:
    tree = given.tree.resolve()
    sys.path.insert(0, str(tree))
    nhjax = importlib.import_module("nhjax")
    if not Path(nhjax.__file__ or "").is_relative_to(tree):
        raise SystemExit(f"nhjax was imported from {nhjax.__file__}, not from {tree}.")
    jax.config.update("jax_enable_x64", True)
    found = deepest_stacks(nhjax)
    figures = measured(tree, found)
    name = given.record or "this checkout"
    if given.record:
        recorded = recorded_figures() | {given.record: figures}
        text = json.dumps(recorded, indent=2) + "\n"
        (DOCS / "rooms.json").write_text(text, encoding="utf-8")
    if given.json:
        print(json.dumps(figures, indent=2))
    else:
        print("\n".join(table({name: figures})))
    if given.stacks:
        for name, stack in found.items():
            print(f"\n{name}:")
            print("\n".join(f"  {file}: {function}" for file, function in stack.frames))


if __name__ == "__main__":
    main()

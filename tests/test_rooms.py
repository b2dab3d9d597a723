"""The rooms of nhjax: imports only go down, and only to the `__init__` of a room."""

import ast
import re
from pathlib import Path

import pytest

import nhjax
from docs import rooms
from nhjax._numerics._kept import kept_call


SOURCES = rooms.read_sources()
IMPORTS = rooms.read_imports(SOURCES)


def test_every_module_is_in_a_room():
    assert {rooms.room(module) for module in SOURCES} - {""} == set(rooms.ROOMS)


def test_imports_of_rooms_point_down():
    assert [
        f"{i.importer}:{i.line} -> {i.imported}" for i in rooms.upward(IMPORTS)
    ] == []


def test_imports_between_rooms_have_no_cycle():
    pairs = [
        (rooms.room(i.importer), rooms.room(i.imported))
        for i in rooms.between_rooms(IMPORTS)
    ]
    assert rooms.circle(pairs) is None


def test_imports_between_modules_have_no_cycle():
    assert rooms.circle((i.importer, i.imported) for i in IMPORTS) is None


def test_imports_from_another_room_use_its_init():
    """Names inside a folder are imported only from its `__init__`."""
    around = [
        f"{i.importer}:{i.line} -> {i.imported}"
        for i in rooms.between_rooms(IMPORTS)
        if "." in i.imported
    ]
    assert around == []


@pytest.mark.parametrize("room", sorted({*rooms.ROOMS, "_integrate._events"}))
def test_room_has_at_most_five_floors(room):
    assert rooms.num_floors(IMPORTS, room) <= 5


def test_floors_of_made_up_room_equal_its_longest_import_chain():
    found = _made_up(
        _low="from ._a import x",
        _low___a="from ._b import x\nfrom ._c import x",
        _low___b="from ._c import x",
        _low___c="",
        _high="from ._low import x",
    )
    assert rooms.num_floors(found, "_low") == 3
    assert rooms.num_floors(found, "_high") == 1


@pytest.mark.parametrize("room", rooms.ROOMS)
def test_room_docstring_states_its_purpose(room):
    assert rooms.purpose(SOURCES[room]).endswith(".")


def test_rooms_page_equals_generated_page():
    page = (rooms.DOCS / "rooms.md").read_text(encoding="utf-8")
    assert page == rooms.page(SOURCES), "run `python docs/rooms.py`"


# A made-up package, to test that forbidden imports are found.
FLOORS = ("_low", "_high")


def _made_up(**modules):
    texts = {name.replace("__", "."): text for name, text in modules.items()}
    return rooms.read_imports({"": "", **texts})


def test_upward_import_of_made_up_package_is_detected():
    found = _made_up(
        _low="from ._inner import x",
        _low___inner="def f():\n    from .._high import y",
        _high="from ._low import x",
    )
    up = rooms.upward(found, FLOORS)
    assert up == [rooms.Import("_low._inner", "_high", 2)]
    between = rooms.between_rooms(found)
    assert rooms.circle(
        (rooms.room(i.importer), rooms.room(i.imported)) for i in between
    )


@pytest.mark.parametrize(
    "text",
    [
        "import pkg._high",
        "import pkg._high as high",
        "from pkg import _high",
        "from pkg._high import x",
        "from . import _high",
        "from ._high import x",
        "if TYPE_CHECKING:\n    from ._high import x",
    ],
)
def test_import_in_every_form_is_read(text):
    sources = {"": "", "_low": text, "_high": "x = 1"}
    found = rooms.read_imports(sources, "pkg")
    assert rooms.upward(found, FLOORS)
    assert not rooms.upward(found, FLOORS[::-1])


def test_import_from_the_package_itself_is_upward():
    found = _made_up(_low="from . import x")
    assert rooms.upward(found, FLOORS)


def test_downward_imports_of_made_up_package_are_accepted():
    found = _made_up(
        _low="import numpy\nfrom numpy import _high",
        _high="from ._low import x",
        _high___inner="from .._low import x\nfrom . import _other",
        _high___other="from .._low import x",
    )
    assert rooms.upward(found, FLOORS) == []
    assert rooms.Import("_high._inner", "_high._other", 2) in found


def test_import_that_bypasses_the_init_is_detected():
    found = _made_up(_low="", _low___inner="", _high="from ._low._inner import x")
    assert [i.imported for i in rooms.between_rooms(found)] == ["_low._inner"]


def test_import_cycle_is_detected():
    chain = [("a", "b"), ("b", "c"), ("a", "c")]
    assert rooms.circle(chain) is None
    assert rooms.circle([*chain, ("c", "a")]) == ["a", "b", "c", "a"]


# Parts of JAX and equinox that may disappear without notice.
INTERNAL = re.compile(
    r"\bjax\.(core|extend|interpreters|_src)\b|\bjaxlib\.|\.primitive\b"
    r"|\b(eqx|equinox)\.internal\b|xla_cpu_\w+|XLA_FFI|\._value\b|\.eqns\b"
    r"|\bequation\.params\b|get_bind_params|GatherScatterMode|DropVar"
)


def test_modules_with_jax_internals_are_listed_on_their_page():
    page = (rooms.DOCS / "jax_internals.md").read_text(encoding="utf-8")
    leaning = {module for module, text in SOURCES.items() if INTERNAL.search(text)}
    named = re.findall(r"`((?:\w+/)?_\w+)\.py`", page)
    assert leaning == {name.replace("/", ".") for name in named}


def test_test_files_do_not_import_each_other():
    """What several tests need is in `tests/support` and in `conftest.py`."""
    folder = Path(__file__).parent
    tests = {path.stem: path for path in folder.rglob("test_*.py")}
    assert len(tests) > 100
    found = []
    for name, path in tests.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules = []
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                modules = [node.module or "", *(alias.name for alias in node.names)]
            parts = {part for module in modules for part in module.split(".")}
            found += [f"{name} <- {other}" for other in parts & tests.keys()]
    assert found == []


@pytest.mark.parametrize(
    ("transformation", "program"), [("plain", "_chunk"), ("grad", "run")]
)
def test_measured_stacks_lead_from_integrate_to_lagrangian(transformation, program):
    found = rooms.stacks(nhjax, transformation)
    assert all(stack.frames[0][1] == "integrate" for stack in found)
    inside = rooms.deepest(stack for stack in found if stack.passes(rooms.ITERATION))
    assert ("_integrate/_run.py", program) in inside.frames
    assert inside.frames[-1][0] == "_numerics/_kept.py"
    assert 10 < len(inside.frames) < 50
    assert 5 < inside.num_files < len(inside.frames)


def test_deepest_stack_has_most_frames():
    frames = (("_a.py", "integrate"), ("_b.py", "iterate"), ("_a.py", "f"))
    stack = rooms.Stack(frames)
    assert stack.passes("iterate")
    assert not stack.passes("step")
    assert stack.num_files == 2
    assert rooms.deepest([rooms.Stack(frames[:2]), stack]) == stack


def test_measuring_stacks_restores_patched_operations():
    before = kept_call.bind
    rooms.stacks(nhjax, "plain")
    assert kept_call.bind == before


def test_measured_figures_count_files_lines_and_floors(tmp_path):
    for path, text in {
        "nhjax/__init__.py": "from ._a import x\n",
        "nhjax/_a/__init__.py": "from ._b import x\n",
        "nhjax/_a/_b.py": "from ._c import x\n",
        "nhjax/_a/_c.py": "from ..systems import x\n\n",
        "nhjax/systems/__init__.py": "x = 1\n",
        "tests/test_a.py": "\n\n\n",
        "benchmarks/a.py": "\n",
        "docs/website/a.txt": "\n",
    }.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text, encoding="utf-8")
    found = {"plain": rooms.Stack((("_a.py", "integrate"), ("_a.py", "run")))}
    assert rooms.measured(tmp_path, found) == {
        "files, nhjax": 5,
        "lines, nhjax": 6,
        "files, nhjax without the gallery": 4,
        "lines, nhjax without the gallery": 5,
        "files, tests": 1,
        "lines, tests": 3,
        "files, benchmarks": 1,
        "lines, benchmarks": 1,
        "files, docs/website": 0,
        "lines, docs/website": 0,
        "arrows between rooms": 1,
        "floors of the deepest room": 2,
        "floors, _a": 2,
        "frames, plain": 2,
        "files of the frames, plain": 1,
    }

"""The compiler is a separate library: it imports nothing from the rest of nhjax."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import nhjax.lanes
from docs import rooms


FOLDER = Path(nhjax.lanes.__file__).parent
SOURCES = rooms.read_sources()
IMPORTS = rooms.read_imports(SOURCES)

# Load the folder as a package with another name, without nhjax.
ALONE = """
import importlib.util, sys
sys.modules["nhjax"] = None
folder = sys.argv[1]
spec = importlib.util.spec_from_file_location(
    "compiler", f"{folder}/__init__.py", submodule_search_locations=[folder]
)
compiler = importlib.util.module_from_spec(spec)
sys.modules["compiler"] = compiler
spec.loader.exec_module(compiler)

import jax
program = jax.make_jaxpr(lambda x: jax.numpy.sin(x) * x)(1.0)
name = compiler.compile_batched(program, (True,))
x = jax.numpy.arange(5.0)
call = jax.ffi.ffi_call(name, jax.ShapeDtypeStruct(x.shape, x.dtype))
assert abs(call(x) - jax.numpy.sin(x) * x).max() < 1e-6
assert abs(compiler.vmap(jax.numpy.sin)(x) - jax.numpy.sin(x)).max() < 1e-6
assert compiler.engines(compiler.vmap(jax.numpy.sin), x)[0].engine == "lanes"
print("works alone")
"""


def test_lanes_modules_import_no_other_module_of_nhjax():
    outside = [
        f"{found.importer}:{found.line} -> {found.imported}"
        for found in IMPORTS
        if rooms.room(found.importer) == "lanes"
        if rooms.room(found.imported) != "lanes"
    ]
    assert outside == []


def test_lanes_compiler_without_nhjax_compiles_and_runs():
    command = [sys.executable, "-c", ALONE, str(FOLDER)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.stdout == "works alone\n", run.stderr


def test_lanes_import_chains_have_at_most_five_modules():
    # `__init__` is the first module of a chain.
    assert 1 + rooms.num_floors(IMPORTS, "lanes") <= 5


README = (FOLDER / "README.md").read_text(encoding="utf-8")


def test_lanes_readme_names_functions_that_exist():
    stops = re.findall(r"^\| `(_\w+)\.py` \| `([\w.]+)` \|", README, re.MULTILINE)
    assert len(stops) > 15
    for file, name in stops:
        last = name.split(".")[-1]
        pattern = rf"^ *(def|class) {last}\b"
        assert re.search(pattern, SOURCES[f"lanes.{file}"], re.MULTILINE), name


EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.parametrize("example", EXAMPLES, ids=["functions", "compiler"])
def test_lanes_readme_example_runs(example, capsys):
    expected = re.search(r"# (\[.*\])", example)
    exec(example, {})
    assert expected is not None
    assert capsys.readouterr().out.strip() == expected[1]


def test_lanes_readme_quotes_the_ir_of_its_example():
    space = {}
    exec(EXAMPLES[1], space)
    text = nhjax.lanes.llvm_ir(space["program"], (True, False), 4)
    quoted = "".join(re.findall(r"```llvm\n(.*?)```", README, re.DOTALL)).splitlines()
    lines = [line for line in quoted if line.strip() != "..."]
    assert len(lines) > 20
    for line in lines:
        assert line.split("...")[0] in text


def test_lanes_readme_lists_all_files_and_functions():
    files = {module.removeprefix("lanes.") for module in SOURCES if "lanes." in module}
    last = README[README.index("## The files") :]
    assert files <= set(re.findall(r"`(_\w+)`", last))
    door = {name for name in vars(nhjax.lanes) if not name.startswith("_")}
    assert door - {"CompiledCode"} <= set(
        re.findall(r"^\| `(\w+)", README, re.MULTILINE)
    )

# ruff: noqa: E402 -- libraries read the environment when they are loaded.
import gc
import importlib.metadata
import os
import shutil
from pathlib import Path


# Solving with a matrix of about 50 rows takes less time than synchronising threads, and
# the workers of pytest-xdist already use all cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Nearly all the time goes into tracing and compiling programs that run once. These
# flags select the compiler's older, quicker code generator, with one piece of code
# rather than 32. The backend reads them when it starts; flags in the environment come
# last and win.
QUICK_FLAGS = (
    "--xla_cpu_parallel_codegen_split_count=1 "
    # Disable passes over loops, which take a quarter of the time.
    "--xla_disable_hlo_passes=while-loop-invariant-code-motion,simplify-while-loops"
)
# From 0.11.1 on there is no older code generator, and an unknown flag ends the process
# without a message.
if tuple(map(int, importlib.metadata.version("jaxlib").split(".")[:3])) < (0, 11, 1):
    QUICK_FLAGS = f"--xla_cpu_use_fusion_emitters=false {QUICK_FLAGS}"
os.environ["XLA_FLAGS"] = f"{QUICK_FLAGS} {os.environ.get('XLA_FLAGS', '')}".strip()

# Programs are compiled once for all processes and runs of the tests. A run whose
# programs are all in the cache takes a third less time. Environment variables that are
# already set keep their values.
CACHE = Path(__file__).parent.parent / ".pytest_cache" / "compiled"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

# By default Python's collector looks for cycles after every 700 new objects, which
# takes a third of the time of a long trace. Traced objects stay in caches anyway. The
# libraries below also load faster.
gc.set_threshold(100_000)

import jax
import pytest

from nhjax.lanes import _program


jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_sessionstart(session):
    """Start with an empty cache if it has grown beyond a gigabyte."""
    is_worker = hasattr(session.config, "workerinput")
    size = sum(path.stat().st_size for path in CACHE.rglob("*") if path.is_file())
    if not is_worker and size > 1e9:
        shutil.rmtree(CACHE)


# Each file runs in one process. The longest files come first, so that no process still
# runs one of them when the others have finished.
LONGEST = (
    "test_as_users_run.py",
    "systems/test_bicycle_stability.py",
    "test_fitting.py",
    "integrate/test_engines.py",
    "integrate/test_gallery_derivatives.py",
    "test_notebooks.py",
    "integrate/test_geometry.py",
    "integrate/test_group_convergence.py",
    "integrate/test_adjoints.py",
    "integrate/test_convergence.py",
    "step/test_forms.py",
    "test_docstrings.py",
    "studies/test_studies.py",
    "integrate/test_invariants.py",
    "integrate/test_step_controllers.py",
    "step/test_accepted_steps.py",
    "step/test_round_off.py",
    "test_example_robots.py",
    "test_friction.py",
    "test_guide.py",
    "test_robots.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first, and leave all others in their order."""
    here = Path(__file__).parent
    rank = {here / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


# Files that use the same runs, which each process caches.
TOGETHER = ("tests/integrate/test_geometry.py", "tests/step/test_stage_equations.py")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give each file to one process, and those in TOGETHER to the same one."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return TOGETHER[0] if file.endswith(TOGETHER) else file

    # If the user selects another distribution, such as `--dist=load`, it is kept.
    if config.getoption("dist") == "loadfile":
        return Scheduling(config, log)


@pytest.fixture(autouse=True, scope="session")
def rare_garbage_collection():
    """Collect rarely: most traced objects stay, and a search takes 10% of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)


@pytest.fixture(autouse=True, scope="module")
def quick_compilation():
    """Most programs run once, and optimising them takes longer than running them."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="module")
def optimised_kernels():
    """Optimise nhjax's kernels, as for users; XLA still compiles the rest quickly."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_program, "is_quick", lambda: False)
        yield


# By default Linux allows a process 65530 memory maps.
MANY_MAPS = 40_000
MAPS = Path("/proc/self/maps")


@pytest.fixture(autouse=True, scope="module")
def few_compiled_programs():
    """Drop compiled programs once they hold many memory maps, which are limited.

    Until then, all modules share small programs, such as an index into an array.
    """
    yield
    # Only Linux shows how many maps a process has.
    if not MAPS.exists() or MAPS.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(
    params=("lanes", "kernels", pytest.param("xla", marks=pytest.mark.long))
)
def engine(request, monkeypatch):
    """The engine that compiles all programs; programs of other engines are dropped."""
    monkeypatch.setenv("NHJAX_ENGINE", request.param)
    jax.clear_caches()
    yield request.param
    jax.clear_caches()


@pytest.fixture
def closed_figures():
    """Draw without a screen, and leave no figures open."""
    import matplotlib
    from matplotlib import pyplot as plt

    matplotlib.use("Agg")
    yield
    plt.close("all")

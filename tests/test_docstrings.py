"""The examples in the docstrings run, and print what they say."""

import doctest
import importlib
import inspect
import pkgutil

import pytest

import nhjax


def _modules():
    names = ["nhjax"]
    for module in pkgutil.walk_packages(nhjax.__path__, "nhjax."):
        # Importing it runs the command line.
        if not module.name.endswith("__main__"):
            names.append(module.name)
    return names


def _examples():
    finder = doctest.DocTestFinder(exclude_empty=True)
    for name in _modules():
        for test in finder.find(importlib.import_module(name), name):
            if test.examples:
                yield test


def _public_objects():
    for space in (nhjax, nhjax.systems):
        for name in dir(space):
            value = getattr(space, name)
            if not name.startswith("_") and not inspect.ismodule(value):
                yield f"{space.__name__}.{name}", value


@pytest.mark.parametrize("example", list(_examples()), ids=lambda test: test.name)
def test_docstring_example_prints_as_shown(example):
    report = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    runner.run(example, out=report.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(report)


@pytest.mark.parametrize(
    ("name", "value"),
    list(_public_objects()),
    ids=[name for name, _ in _public_objects()],
)
def test_docstring_of_every_public_object_exists(name, value):
    text = value.__doc__ or ""
    assert text.strip(), name
    # Python generates such a text if there is no docstring.
    assert not text.startswith(f"{getattr(value, '__name__', name)}("), name


def test_docstring_examples_are_collected():
    tested = {test.name for test in _examples()}
    for module, name in (
        ("_integrate._integrate", "integrate"),
        ("_integrate._saving", "SaveAt"),
        ("_initial._initial_state", "initial_state"),
    ):
        assert f"nhjax.{module}.{name}" in tested
    assert len(tested) > 20

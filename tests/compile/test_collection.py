"""Garbage is collected rarely inside a block, and as usual after it."""

import gc
import threading

import pytest

from nhjax.lanes import rare_collections


@pytest.fixture(autouse=True)
def as_python_starts():
    before = gc.get_threshold()
    gc.set_threshold(700, 10, 10)
    yield
    gc.set_threshold(*before)


def test_garbage_collection_is_rarer_inside_and_restored_after():
    with rare_collections():
        first, *rest = gc.get_threshold()
        with rare_collections():
            assert gc.get_threshold() == (first, *rest)
        assert gc.get_threshold() == (first, *rest)
    assert first > 10_000
    assert rest == [10, 10]
    assert gc.get_threshold() == (700, 10, 10)


def test_garbage_collection_after_error_is_restored():
    with pytest.raises(KeyError), rare_collections():
        raise KeyError
    assert gc.get_threshold() == (700, 10, 10)


@pytest.mark.parametrize("first", [0, 1_000_000])
def test_garbage_collection_that_is_off_or_rarer_is_unchanged(first):
    gc.set_threshold(first, 10, 10)
    with rare_collections():
        assert gc.get_threshold() == (first, 10, 10)
    assert gc.get_threshold() == (first, 10, 10)


def test_garbage_collection_is_restored_by_last_thread():
    entered, leave = threading.Event(), threading.Event()

    def other():
        with rare_collections():
            entered.set()
            leave.wait(10)

    thread = threading.Thread(target=other)
    with rare_collections():
        thread.start()
        assert entered.wait(10)
    assert gc.get_threshold()[0] > 10_000
    leave.set()
    thread.join()
    assert gc.get_threshold() == (700, 10, 10)

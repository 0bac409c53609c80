"""Working ahead in threads is ``map``, and stops when nobody listens."""

import threading
import time
from contextlib import closing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from probscene.prefetch import ahead


@given(st.lists(st.integers(), max_size=12), st.integers(1, 4))
def test_it_is_map(items, threads):
    assert list(ahead(lambda x: 2 * x, items, threads)) == [2 * x for x in items]


def test_one_thread_works_in_order():
    begun = []
    assert list(ahead(lambda x: begun.append(x) or x, range(20))) == list(range(20)) == begun


def test_what_goes_wrong_comes_in_its_turn_and_ends_it():
    def work(x):
        if x == 3:
            raise ValueError(x)
        return x

    found = []
    with pytest.raises(ValueError, match="3"), closing(ahead(work, range(100), 2)) as results:
        for result in results:
            found.append(result)
    assert found == [0, 1, 2]


def test_closed_early_it_leaves_no_thread_and_begins_nothing_more():
    begun, before = [], threading.active_count()

    def work(x):
        begun.append(x)
        time.sleep(0.01)
        return x

    with closing(ahead(work, range(1000), 2)) as results:
        assert next(results) == 0
    number = len(begun)
    assert number <= 6 and threading.active_count() == before

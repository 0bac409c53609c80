"""Work in other threads, a little ahead of who needs it."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def ahead(work: Callable[[Item], Result], items: Iterable[Item], threads: int = 1) -> Generator[Result]:
    """``map(work, items)``, in order, while up to one more item a thread is worked on.

    With one thread the items are worked on one after the other, in order. Close the iterator, as with
    ``contextlib.closing``, where it may not come to its end: that waits for the work that has begun.
    """
    with ThreadPoolExecutor(threads) as pool:
        waiting = deque()
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) > threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)

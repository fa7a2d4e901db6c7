"""One thread that works beside the caller's."""

import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any, TypeAlias, TypeVar

Result = TypeVar("Result")
_Todo: TypeAlias = "SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None]"


class Helper:
    """A thread that sleeps on a queue, and lives as long as this does.

    ``ThreadPoolExecutor`` takes no more work once the program's main thread has ended, although a control loop on
    another thread may go on for hours.
    """

    def __init__(self, name: str) -> None:
        self._todo: _Todo = SimpleQueue()
        self._thread = threading.Thread(target=_work, args=(self._todo,), name=name, daemon=True)
        self._thread.start()
        weakref.finalize(self, self._todo.put, None).atexit = False

    def submit(self, work: Callable[[], Result]) -> Future[Result]:
        """Have something done, after what was submitted before."""
        future: Future[Result] = Future()
        self._todo.put((future, work))
        return future

    def end(self, timeout: float) -> None:
        """Do what was submitted and nothing else, and wait for the end of it, for so many seconds at most."""
        self._todo.put(None)
        self._thread.join(timeout)


def _work(todo: _Todo) -> None:
    while (item := todo.get()) is not None:
        future, work = item
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)
        del item, future, work  # while it sleeps, the thread keeps nothing of a call

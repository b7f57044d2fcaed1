"""Who does the parallel work of a search: this thread, threads of this process, or a dask.distributed cluster.

Whoever does it, the answer is the same bit for bit: tasks come back in the order in which they were given, every sum
is taken in one order by one place, and BLAS keeps to one thread (two threads add in another order than one).
"""

import asyncio
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import cache
from typing import Any, Protocol, Self, TypeVar

from threadpoolctl import ThreadpoolController

from stagectl import sources
from stagectl.errors import LinkError, RequestError

Item = TypeVar("Item")
Result = TypeVar("Result")

_ANSWER_S = 10.0
"""So long a scheduler, or the first worker of its cluster, may take to answer."""

_SWITCH_S = 2e-4
"""After so long a thread hands the interpreter on to others that wait for it. A search with several effects took 26.7 s
of two threads, with the usual 5 ms 27.7 s."""

_LENT_COUNT = 4
"""Values that a cluster keeps for tasks to come; what was asked for longest ago goes first."""


class Crew(Protocol):
    """Does tasks; used as a context, nothing of it is left behind."""

    is_elsewhere: bool
    """Whether `map` works in other processes: then whole searches are better tasks than parts of one."""

    def here(self, task: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """Do a task for each item in this process: its results are large, or it can't travel."""
        ...

    def helped(self, task: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Do a part of a task for each item, in the thread that asks and in those that have nothing to do."""
        ...

    def map(self, task: Callable[..., Result], shared: Sequence[object], items: Iterable[Item]) -> list[Result]:
        """Return task(*shared, item) for each item, in their order; all of it can be pickled, `shared` travels once."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: object, error: object, trace: object) -> None: ...


class Serial:
    """Everything one after the other in the thread that asks."""

    is_elsewhere = False

    def here(self, task: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """Do a task for each item."""
        return [task(item) for item in items]

    def helped(self, task: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Do a part of a task for each item."""
        return [task(item) for item in items]

    def map(self, task: Callable[..., Result], shared: Sequence[object], items: Iterable[Item]) -> list[Result]:
        """Return task(*shared, item) for each item."""
        return [task(*shared, item) for item in items]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        """Leave nothing."""


class Threads:
    """Threads of this process: compiled laws and numpy let go of the interpreter, and nothing has to travel.

    Two processes were faster at the search of shapes alone (1.8 against 1.4 times one thread's speed), but not at a
    whole search with several effects: 97 s with two threads, 135 s with one, 137 s with processes that are forked for
    each `map` and forget the columns of its trials, more than 250 s on a cluster of two.
    """

    is_elsewhere = False

    def __init__(self, workers_count: int):
        """Errors: RequestError where there would be no worker."""
        if workers_count < 1:
            raise RequestError(f"{workers_count} workers do nothing; give 1 or more, at most as many as processors")
        self._pool = ThreadPoolExecutor(workers_count, thread_name_prefix="gap")
        self._helpers = ThreadPoolExecutor(workers_count, thread_name_prefix="gap-helper")
        self._workers_count, self._busy_count, self._lock = workers_count, 0, threading.Lock()
        self._interval_s = sys.getswitchinterval()

    def here(self, task: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """Do a task for each item."""

        def counted(item: Item) -> Result:
            self._count(1)
            try:
                return task(item)
            finally:
                self._count(-1)

        return list(self._pool.map(counted, items))

    def helped(self, task: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Do a part of a task for each item, in the thread that asks and in those that have nothing to do.

        Of a search on two recordings the shapes of bristles took half the time, one search after the other: 30.4 s with
        two threads, 23.3 s where the second one takes one of the recordings.
        """
        helpers_count = self._taken(len(items) - 1)
        if helpers_count == 0:
            return [task(item) for item in items]
        shares = [items[first :: helpers_count + 1] for first in range(helpers_count + 1)]
        try:
            others = [self._helpers.submit(lambda share=share: [task(item) for item in share]) for share in shares[1:]]
            done = [[task(item) for item in shares[0]], *(one.result() for one in others)]
        finally:
            self._count(-helpers_count)
        return [done[number % len(done)][number // len(done)] for number in range(len(items))]

    def map(self, task: Callable[..., Result], shared: Sequence[object], items: Iterable[Item]) -> list[Result]:
        """Return task(*shared, item) for each item."""
        return self.here(lambda item: task(*shared, item), items)

    def _taken(self, most: int) -> int:
        """Take as many threads as have nothing to do, and return how many; who asks has something to do."""
        with self._lock:
            count = max(min(most, self._workers_count - max(self._busy_count, 1)), 0)
            self._busy_count += count
        return count

    def _count(self, change: int) -> None:
        with self._lock:
            self._busy_count += change

    def __enter__(self) -> Self:
        """Hand the interpreter on sooner while the threads work: what waits for it 5 ms could compute meanwhile."""
        sys.setswitchinterval(_SWITCH_S)
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        """End the threads; after an error or Ctrl-C what has not begun never begins."""
        sys.setswitchinterval(self._interval_s)
        self._workers_count = 1  # nobody helps any more
        for pool in (self._pool, self._helpers):
            pool.shutdown(wait=error is None, cancel_futures=True)


def crew_of(workers_count: int) -> Serial | Threads:
    """Return who works on so many processors of this machine. Errors: RequestError."""
    return Serial() if workers_count == 1 else Threads(workers_count)


class Dask:
    """Workers of a dask.distributed cluster that somebody else has started, and that goes on afterwards."""

    is_elsewhere = True

    def __init__(self, address: str, answer_s: float = _ANSWER_S):
        """Errors: RequestError where distributed is not installed, LinkError where no fitting worker answers."""
        try:
            import distributed
        except ImportError as error:
            raise RequestError(
                f"--dask {address}: the package distributed is not installed; pip install 'stagectl[fleet]'"
            ) from error
        self._address = address
        self._failures = _failures()
        self._lent: OrderedDict[int, tuple[object, Any]] = OrderedDict()
        try:
            with ThreadPoolExecutor(1) as apart:  # of an event loop that the caller may be in
                kind = apart.submit(asyncio.run, _kind_of(address, answer_s)).result()
            if kind != "Scheduler":
                raise ValueError(f"a {kind} does")
            self._client = distributed.Client(address, timeout=answer_s, set_as_default=False)
        except (OSError, ValueError, TypeError, TimeoutError, ImportError) as error:
            said = " ".join(str(error).split()) or type(error).__name__
            raise LinkError(
                f"--dask {address}: no dask scheduler answers there within {answer_s:g} s ({said}); start one with "
                "`dask scheduler` and give the address that it prints, such as tcp://192.168.1.7:8786"
            ) from error
        with ExitStack() as refused:
            refused.callback(self._client.close)
            self._check(answer_s)
            refused.pop_all()

    def _check(self, answer_s: float) -> None:
        """Refuse a cluster without workers, or with workers of another stagectl."""
        try:
            self._client.wait_for_workers(1, timeout=answer_s)
        except TimeoutError as error:
            raise LinkError(
                f"--dask {self._address}: the scheduler has no worker after {answer_s:g} s; start one with "
                f"`dask worker {self._address}`"
            ) from error
        try:
            versions: Any = self._client.run(sources.version)
        except self._failures as error:
            raise self._lost(error) from error
        except ImportError as error:
            raise LinkError(
                f"--dask {self._address}: its workers can't import stagectl ({error}); start them in an environment "
                "with the same stagectl as here"
            ) from error
        for worker, version in versions.items():
            if version != sources.version():
                raise LinkError(_other_version(f"--dask {self._address}: worker {worker}", version))

    def _lost(self, error: BaseException) -> LinkError:
        said = " ".join(str(error).split()) or type(error).__name__
        return LinkError(
            f"--dask {self._address}: the cluster was lost at work ({type(error).__name__}: {said}); look at the "
            "workers' logs (memory?), or use --workers"
        )

    def here(self, task: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """Do a task for each item: what is large stays here."""
        return [task(item) for item in items]

    def helped(self, task: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Do a part of a task for each item, in this process."""
        return [task(item) for item in items]

    def map(self, task: Callable[..., Result], shared: Sequence[object], items: Iterable[Item]) -> list[Result]:
        """Return task(*shared, item) for each item, by the workers."""
        try:
            lent = [self._travelled(value) for value in shared]
            waiting = [
                self._client.submit(_worked, sources.version(), task, *lent, item, pure=False, retries=1)
                for item in items
            ]
            return self._client.gather(waiting)  # pyright: ignore[reportReturnType]
        except self._failures as error:
            raise self._lost(error) from error

    def _travelled(self, value: object) -> Any:
        """Return what stands for a value on all workers, sent there where it is not yet."""
        key = id(value)
        if key not in self._lent:
            self._lent[key] = value, self._client.scatter(value, broadcast=True, hash=False)  # held: ids come again
            while len(self._lent) > _LENT_COUNT:
                self._lent.popitem(last=False)
        self._lent.move_to_end(key)
        return self._lent[key][1]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        """Let go of the cluster: what waits there for us is cancelled."""
        self._lent.clear()
        self._client.close()


async def _kind_of(address: str, answer_s: float) -> str:
    """Return what kind of server answers; TimeoutError where none does: a client would wait for a mute one for ever."""
    from distributed.core import rpc

    async with rpc(address, timeout=answer_s) as server:
        identity = await asyncio.wait_for(server.identity(), 1.5 * answer_s)
    return str(dict(identity or {}).get("type", "server of another kind"))


def _failures() -> tuple[type[BaseException], ...]:
    """Return what distributed raises where a cluster is lost."""
    from distributed import CancelledError as Cancelled
    from distributed import KilledWorker
    from distributed.comm.core import CommClosedError

    return KilledWorker, CommClosedError, Cancelled, CancelledError, TimeoutError, OSError


def _other_version(who: str, version: str) -> str:
    here = sources.version()
    return f"{who} has another stagectl (sources {version}, here {here}); install the same one on every worker"


def _worked(version: str, task: Callable[..., Result], *arguments: Any) -> Result:
    """Do a task on a worker, which may have joined after the others were looked at."""
    if version != sources.version():
        raise LinkError(_other_version("a worker that joined later", version))
    with one_blas_thread():
        return task(*arguments)


@cache
def _libraries() -> ThreadpoolController:
    """Find the libraries that have thread pools, once: looking takes milliseconds."""
    import numpy.linalg  # noqa: F401
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()


class _Limit:
    """How many at once want BLAS on one thread; the first one sets it, the last one gives the threads back."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.count = 0
        self.held: AbstractContextManager[Any] | None = None


_LIMIT = _Limit()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep BLAS to one thread: workers share the processors, and sums come out the same whoever takes them."""
    with _LIMIT.lock:
        if _LIMIT.count == 0:
            _LIMIT.held = _libraries().limit(limits=1, user_api="blas")
            _LIMIT.held.__enter__()
        _LIMIT.count += 1
    try:
        yield
    finally:
        with _LIMIT.lock:
            _LIMIT.count -= 1
            if _LIMIT.count == 0 and _LIMIT.held is not None:
                _LIMIT.held.__exit__(None, None, None)
                _LIMIT.held = None

"""A parallel map over independent items, on the cores of this machine or on a Dask cluster.

The results are those of a plain loop, in the order of the items. Random numbers must therefore depend on the item,
not on the worker.
"""

from __future__ import annotations

import importlib
import logging
import signal
import threading
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from typing import Any, Generic, TypeVar

import cv2

from slipguard import __version__
from slipguard.errors import InputError, SlipguardError

T = TypeVar("T")
R = TypeVar("R")
AHEAD_PER_CORE = 4
"""Items submitted to a cluster ahead of the next result: enough to keep it busy, with few results in memory."""
CONNECT_S = 10.0


@dataclass(frozen=True, slots=True)
class Workers:
    """Where to compute. jobs: processes on this machine, 0 for one per core. cluster: Dask scheduler, tcp://HOST:8786."""

    jobs: int = 0
    cluster: str | None = None

    def __post_init__(self) -> None:
        if self.jobs < 0:
            raise InputError(f"--jobs {self.jobs}: must be at least 1, or 0 for one process per core")


def each(
    work: Callable[[T], R],
    items: Sequence[T],
    workers: Workers | None = None,
    *,
    named: Callable[[T], str] = str,
    progress: Callable[[int], None] = lambda done: None,
) -> Generator[R, None, None]:
    """Yield work(item) for every item, in the order of the items.

    The workers stop when the iterator is closed, also by an exception.

    Args:
        work: Function of an item. Function and items must be picklable, except for one job or one item.
        named: Returns the name of an item for error messages.
        progress: Called with the number of results so far.

    Raises:
        SlipguardError: From an item, with the item's name in front. Other exceptions keep their type and get a note.
        InputError: If the cluster does not respond.
    """
    task = _Task(work, named)
    results: Generator[R | _ItemFailure, None, None]
    if workers is not None and workers.cluster is not None:
        results = _on_cluster(task, items, workers.cluster)
    else:
        jobs = min(_job_count(workers.jobs if workers else 0), len(items))
        results = _in_processes(task, items, jobs) if jobs > 1 else (task(item) for item in items)
    with closing(results):
        for done, result in enumerate(results, 1):
            if isinstance(result, _ItemFailure):
                raise result.error
            progress(done)
            yield result


@dataclass(frozen=True, slots=True)
class _ItemFailure:
    """The exception of an item, returned as a result so that failures keep the order of the items."""

    error: Exception


@dataclass(frozen=True, slots=True)
class _Task(Generic[T, R]):
    work: Callable[[T], R]
    named: Callable[[T], str]

    def __call__(self, item: T) -> R | _ItemFailure:
        try:
            return self.work(item)
        except SlipguardError as error:
            return _ItemFailure(type(error)(f"{self.named(item)}: {error}"))
        except Exception as error:
            error.add_note(f"while computing {self.named(item)}\n{traceback.format_exc()}")
            return _ItemFailure(error)


def _job_count(requested: int) -> int:
    if requested:
        return requested
    import joblib

    return int(joblib.cpu_count())


def _in_processes(task: Callable[[T], R], items: Sequence[T], jobs: int) -> Generator[R, None, None]:
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    pool = Parallel(n_jobs=jobs, return_as="generator")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, set())
    resource_tracker.ensure_running()  # its start unblocks SIGINT in older Python versions (CPython issue 127586)
    results = None
    try:
        try:
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by the workers
            results = pool(delayed(_in_worker)(task, item) for item in items)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for result in results:  # noqa: UP028 - `yield from` would close the generator itself, with a warning
            yield result
    except TerminatedWorkerError as error:  # also while the first items are submitted
        raise SlipguardError(
            f"one of {jobs} worker processes ended, possibly out of memory. Use fewer processes with --jobs"
        ) from error
    finally:
        if results is not None:
            with _without_warnings():
                results.close()


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Suppress joblib's warning about unused results, and a KeyError in loky's thread, when workers are stopped."""
    before = threading.excepthook

    def ignore_key_error(failure: threading.ExceptHookArgs) -> None:
        of_loky = failure.thread is not None and failure.thread.name == "ExecutorManagerThread"
        if not (of_loky and failure.exc_type is KeyError):  # it looks up an item that was already removed
            before(failure)

    threading.excepthook = ignore_key_error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        threading.excepthook = before


def _in_worker(task: Callable[[T], R], item: T) -> R:
    """Process one item on one thread, because there is one worker per core."""
    cv2.setNumThreads(1)
    return task(item)


def _on_cluster(task: Callable[[T], R], items: Sequence[T], address: str) -> Generator[R, None, None]:
    with closing(_client(address)) as client:
        ahead = AHEAD_PER_CORE * sum(client.ncores().values())
        waiting: deque[Any] = deque()
        try:
            for item in items:
                if len(waiting) >= ahead:
                    yield waiting.popleft().result()
                waiting.append(client.submit(task, item, pure=False))
            while waiting:
                yield waiting.popleft().result()
        finally:
            if waiting:
                client.cancel(list(waiting))


def _client(address: str) -> Any:
    """Return a client whose workers are connected and run this version of slipguard."""
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        raise InputError("--cluster needs dask. Install it with: pip install 'slipguard[cluster]'") from error
    logging.getLogger("distributed").setLevel(logging.ERROR)  # errors are raised
    try:
        client: Any = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"no Dask scheduler at {address}. Start one with `dask scheduler`, and give tcp://HOST:8786"
        ) from error
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
        versions = client.run(_version)
    except TimeoutError as error:
        client.close()
        raise InputError(f"{address}: no worker is connected. Start workers with `dask worker {address}`") from error
    except Exception as error:
        client.close()
        raise InputError(f"{address}: a worker cannot import slipguard ({error}). Install slipguard there") from error
    other = sorted({version for version in versions.values() if version != __version__})
    if other:
        client.close()
        raise InputError(
            f"{address}: workers run slipguard {', '.join(other)}, this machine {__version__}. Install the same version"
        )
    return client


def _version() -> str:
    return __version__

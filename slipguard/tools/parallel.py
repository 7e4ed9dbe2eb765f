"""Many independent items computed at once, on this machine's cores or on a Dask cluster, as if one after the other.

What comes out is what a plain loop would give: results in the order of the items, whatever computed them. What is
random must therefore follow from the item (`generator`), never from the worker.
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
import numpy as np

from slipguard import __version__
from slipguard.errors import InputError, SlipguardError

T = TypeVar("T")
R = TypeVar("R")
AHEAD_PER_CORE = 4
"""Items a cluster is given ahead of the one waited for: enough to keep it busy, few enough to keep results few."""
CONNECT_S = 10.0


@dataclass(frozen=True, slots=True)
class Workers:
    """Who computes. jobs: processes on this machine, 0 for one per core; cluster: a Dask scheduler, tcp://HOST:8786."""

    jobs: int = 0
    cluster: str | None = None

    def __post_init__(self) -> None:
        if self.jobs < 0:
            raise InputError(f"{self.jobs} jobs are not possible; give 1 or more, or 0 for one per core")


def generator(seed: int, item: int) -> np.random.Generator:
    """The random numbers of one item: the same whichever worker computes it, and whatever came before."""
    return np.random.default_rng([seed, item])


def each(
    work: Callable[[T], R],
    items: Sequence[T],
    workers: Workers | None = None,
    *,
    named: Callable[[T], str] = str,
    progress: Callable[[int], None] = lambda done: None,
) -> Generator[R, None, None]:
    """Yield work(item) of every item, in the order of the items.

    work and items must be picklable unless one process does it all (one job or one item). progress is called with the
    number of results handed out. Close the iterator, or let an exception pass through it, and the workers stop.
    A `SlipguardError` of an item is raised again with the item's name before it; any other exception keeps its type
    and carries the name as a note. Raises `InputError` where no cluster answers.
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
    """What an item came to; carried as a result, so that failures keep the order of the items, too."""

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


def _job_count(asked: int) -> int:
    if asked:
        return asked
    import joblib

    return int(joblib.cpu_count())


def _in_processes(task: Callable[[T], R], items: Sequence[T], jobs: int) -> Generator[R, None, None]:
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    pool = Parallel(n_jobs=jobs, return_as="generator")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, set())
    resource_tracker.ensure_running()  # whose start unblocks SIGINT in an older Python (CPython issue 127586)
    results = None
    try:
        try:
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # the workers start with it
            results = pool(delayed(_in_worker)(task, item) for item in items)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for result in results:  # noqa: UP028 - `yield from` would close them itself, with a warning
            yield result
    except TerminatedWorkerError as error:  # also while the first items are handed out
        raise SlipguardError(
            f"one of {jobs} worker processes died, perhaps for want of memory; try fewer with --jobs"
        ) from error
    finally:
        if results is not None:
            with _quietly():
                results.close()


@contextmanager
def _quietly() -> Iterator[None]:
    """Workers are killed amid their work: joblib warns of results not asked for, and loky's thread may miss one."""
    before = threading.excepthook

    def heard(failure: threading.ExceptHookArgs) -> None:
        of_loky = failure.thread is not None and failure.thread.name == "ExecutorManagerThread"
        if not (of_loky and failure.exc_type is KeyError):  # it looks for an item that it has itself given up
            before(failure)

    threading.excepthook = heard
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        threading.excepthook = before


def _in_worker(task: Callable[[T], R], item: T) -> R:
    """The worker's share: one thread, because the cores are shared out already."""
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
    """A client whose workers are there and run this slipguard."""
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        raise InputError("--cluster needs dask; install it with: pip install 'slipguard[cluster]'") from error
    logging.getLogger("distributed").setLevel(logging.ERROR)  # what matters is raised
    try:
        client: Any = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"no Dask scheduler answers at {address}; start one with `dask scheduler`, and give tcp://HOST:8786"
        ) from error
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
        versions = client.run(_version)
    except TimeoutError as error:
        client.close()
        raise InputError(f"{address}: no worker is connected; start some with `dask worker {address}`") from error
    except Exception as error:
        client.close()
        raise InputError(f"{address}: a worker cannot import slipguard ({error}); install it there") from error
    other = sorted({version for version in versions.values() if version != __version__})
    if other:
        client.close()
        raise InputError(
            f"{address}: workers run slipguard {', '.join(other)}, this is {__version__}; install the same"
        )
    return client


def _version() -> str:
    return __version__

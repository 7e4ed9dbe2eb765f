"""Items computed in parallel give the results of a plain loop, on processes and on a cluster."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from slipguard.errors import InputError, SlipguardError
from slipguard.tools import parallel
from slipguard.tools.parallel import AHEAD_PER_CORE, Workers, each

ITEMS = list(range(12))


def drawn(item: int) -> float:
    return float(np.random.default_rng([7, item]).normal())


def picky(item: int) -> int:
    if item == 5:
        raise InputError("not this one")
    if item == 7:
        raise ZeroDivisionError("by hand")
    return item


def where(item: int) -> int:
    return os.getpid()


def name(item: int) -> str:
    return f"frame {item}"


def dies(item: int) -> None:
    os._exit(1)


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_order_and_do_not_depend_on_the_workers(jobs: int) -> None:
    counts: list[int] = []
    assert list(each(drawn, ITEMS, Workers(jobs), progress=counts.append)) == [drawn(item) for item in ITEMS]
    assert counts == [item + 1 for item in ITEMS]


def test_one_item_or_one_job_needs_no_process() -> None:
    assert set(each(where, [3], Workers(2))) | set(each(where, ITEMS, Workers(1))) == {os.getpid()}
    assert os.getpid() not in set(each(where, ITEMS, Workers(2)))
    assert list(each(drawn, [])) == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_failure_names_its_item(jobs: int) -> None:
    results = each(picky, ITEMS, Workers(jobs), named=name)
    assert [next(results) for _ in range(5)] == [0, 1, 2, 3, 4]
    with pytest.raises(InputError, match=r"^frame 5: not this one$"):
        next(results)
    with pytest.raises(ZeroDivisionError) as caught:
        list(each(picky, [7, 8], Workers(jobs), named=name))
    assert caught.value.__notes__[0].startswith("while computing frame 7\nTraceback")


def test_a_worker_that_ends_gives_one_line() -> None:
    with pytest.raises(SlipguardError, match="worker processes ended"):
        list(each(dies, ITEMS, Workers(2)))


def test_negative_jobs_are_refused() -> None:
    with pytest.raises(InputError, match="--jobs -1"):
        Workers(-1)


@pytest.mark.extras("distributed")
def test_a_missing_scheduler_gives_one_line() -> None:
    with pytest.raises(InputError, match=r"no Dask scheduler at nowhere://x"):
        list(each(drawn, ITEMS, Workers(cluster="nowhere://x")))


BLOCKED = """
import signal
from slipguard.tools.parallel import Workers, each
def work(item):
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, set())
print(*each(work, list(range(4)), Workers(2)), signal.pthread_sigmask(signal.SIG_BLOCK, set()))
"""


def test_workers_ignore_ctrl_c() -> None:
    """In a process of its own: what was started before decides whether the first worker starts with the mask."""
    done = subprocess.run([sys.executable, "-c", BLOCKED], capture_output=True, text=True, timeout=60, check=False)
    assert (done.stdout, done.stderr) == ("True True True True set()\n", "")


SLOW = """
import sys
from slipguard.cli.interrupt import InterruptHandler
import signal, time
signal.signal(signal.SIGINT, InterruptHandler())
from slipguard.tools.parallel import Workers, each
def work(item):
    print(item, flush=True)
    time.sleep(60.0 if item > 2 else 0.3)  # joblib puts several shorter items into one batch
    return item
try:
    for result in each(work, list(range(8)), Workers(2)):
        print("got", result, flush=True)
except KeyboardInterrupt:
    print("stopped", flush=True)
"""


def test_ctrl_c_stops_the_workers_without_output(tmp_path: Path) -> None:
    script = tmp_path / "slow.py"
    script.write_text(SLOW)
    running = subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert running.stdout is not None
    for line in running.stdout:
        if line == "got 2\n":
            break
    os.killpg(running.pid, signal.SIGINT)  # as a terminal does: parent and workers
    out, err = running.communicate(timeout=30)
    assert "stopped\n" in out
    assert err == ""
    for _ in range(600):
        if not alive(running.pid):
            return
        threading.Event().wait(0.05)
    pytest.fail("a worker outlived the Ctrl-C by 30 s")


def alive(group: int) -> bool:
    """Some process of the group is running."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of two workers of one thread each."""
    import distributed

    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None, silence_logs=False
    ) as local:
        yield local.scheduler_address


@pytest.mark.extras("distributed")
def test_a_cluster_gives_the_same_results(cluster: str) -> None:
    counts: list[int] = []
    items = list(range(3 * AHEAD_PER_CORE))
    computed = each(drawn, items, Workers(cluster=cluster), progress=counts.append)
    assert list(computed) == [drawn(item) for item in items]
    assert counts == [item + 1 for item in items]


@pytest.mark.extras("distributed")
def test_a_failure_on_a_cluster_names_its_item(cluster: str) -> None:
    results = each(picky, ITEMS, Workers(cluster=cluster), named=name)
    with pytest.raises(InputError, match=r"^frame 5: not this one$"):
        list(results)


@pytest.mark.extras("distributed")
def test_closing_the_iterator_cancels_the_rest(cluster: str) -> None:
    results = each(drawn, ITEMS, Workers(cluster=cluster))
    assert next(results) == drawn(0)
    results.close()


@pytest.mark.extras("distributed")
def test_a_cluster_of_another_version_is_refused(cluster: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "__version__", "9.9")
    monkeypatch.setattr(parallel, "_version", lambda: "0.0.1")
    with pytest.raises(InputError, match=r"workers run slipguard 0\.0\.1, this machine 9\.9"):
        list(each(drawn, ITEMS, Workers(cluster=cluster)))


def test_only_the_key_error_of_lokys_thread_is_suppressed(monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[str | None] = []
    monkeypatch.setattr(threading, "excepthook", lambda failure: reported.append(failure.thread.name))

    def lost() -> None:
        raise KeyError(29)

    with parallel._without_warnings():
        for name in ("ExecutorManagerThread", "another thread"):
            thread = threading.Thread(target=lost, name=name)
            thread.start()
            thread.join()
    assert reported == ["another thread"]

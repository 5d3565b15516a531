"""Where runs are made: in this process, in several, or on a Dask cluster."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from typing import Any, TypeVar

from maasi_sim.machine import this_machine

Item = TypeVar('Item')

# One thread for each worker; the number of workers sets the load.
_ONE_THREAD = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'NUMBA_NUM_THREADS')
# Longest wait for the scheduler of a cluster and for its first worker [s].
PATIENCE = 20.0


class WorkersLost(RuntimeError):
    """The workers are lost; their finished runs are kept."""


class InThisProcess(Executor):
    """Runs what is submitted at once."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a function and return its result as a future."""
        future: Future[Any] = Future()
        future.set_result(function(*args, **kwargs))
        return future


@dataclass
class Workers:
    """An executor of runs, so many at a time.

    So many are submitted `ahead`; none: all, for workers that join later. `machines` has that of
    each worker by its name, and `close` abandons pending runs.
    """

    executor: Executor = field(default_factory=InThisProcess)
    number: int = 1
    ahead: int | None = 1
    machines: dict[str, dict[str, str]] = field(
        default_factory=lambda: {'this process': this_machine()}
    )
    close: Callable[[], None] = lambda: None

    def make(
        self, function: Callable[[Item], Any], items: Sequence[Item]
    ) -> Iterator[tuple[Item, Any]]:
        """Yield each item with its result, in the order of completion."""
        left = list(reversed(items))
        waiting: dict[Future[Any], Item] = {}
        try:
            while left or waiting:
                while left and len(waiting) < (self.ahead or len(items)):
                    item = left.pop()
                    waiting[self.executor.submit(function, item)] = item
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    yield waiting.pop(future), future.result()
        except Exception as error:
            reason = str(error) or type(error).__name__
            raise WorkersLost(f'a worker died: {reason}') from None


def make_workers(number: int, wanted: int | None = None, cluster: str | None = None) -> Workers:
    """Return workers for `number` runs: at most the wanted processes, or a Dask cluster's."""
    if cluster is not None:
        return _of_cluster(cluster)
    processes = min(wanted or os.cpu_count() or 1, number)
    return _processes(processes) if processes > 1 else Workers()


def _begin() -> None:
    # The main process handles Ctrl-C and shuts down its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _processes(number: int) -> Workers:
    # Spawned: a fresh interpreter on every system.
    pool = ProcessPoolExecutor(number, multiprocessing.get_context('spawn'), _begin)
    before = dict(os.environ)
    os.environ.update(dict.fromkeys(_ONE_THREAD, '1'))

    def close() -> None:
        workers = list((pool._processes or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            with contextlib.suppress(OSError, ValueError):
                worker.terminate()
        os.environ.clear()
        os.environ.update(before)

    return Workers(pool, number, 2 * number, {'this machine': this_machine()}, close)


def _of_cluster(address: str) -> Workers:
    try:
        from distributed import Client
    except ImportError:
        raise WorkersLost("a cluster needs the package 'dask[distributed]'") from None
    try:
        client: Any = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkersLost(f'cluster: no scheduler answers at {address}: {error}') from None
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
        machines = dict(sorted(client.run(this_machine).items()))
    except TimeoutError:
        client.close()
        raise WorkersLost(f'cluster: the scheduler at {address} has no workers') from None
    except Exception as error:
        client.close()
        raise WorkersLost(f'cluster: {type(error).__name__}: {error}') from None
    # One retry if a worker is lost; not pure, so that equal tasks are not merged.
    executor = client.get_executor(pure=False, retries=1)
    return Workers(executor, sum(client.nthreads().values()), None, machines, client.close)

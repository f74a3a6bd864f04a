"""Where tasks run: in this process, on several of this machine, or on a Ray cluster. Results come in the tasks' order."""

from __future__ import annotations

import contextlib
import importlib
import logging
import multiprocessing
import os
import signal
import socket
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol, TypeVar

from potclient.extras import how_to_install
from potserver.errors import DictionaryError

T = TypeVar("T")
R = TypeVar("R")

LOCAL_RAY = "local"
_TASKS_A_WORKER = 3  # handed out at once: no worker waits for the slowest one, and few results are held
# one thread a task, so that sums do not depend on the machine; read by the libraries when a worker loads them
_ONE_THREAD = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "MKL", "OPENBLAS", "NUMBA", "VECLIB_MAXIMUM")
}
_CONNECT_S = 10.0
_RAY_OBJECT_STORE_BYTES = 256 * 2**20


class Engine(Protocol):
    """Runs a module's function on many arguments."""

    def map(self, function: Callable[[T], R], tasks: Iterable[T]) -> Iterator[R]:
        """The results in order, as they come; an error of the function is raised at its place."""


@contextlib.contextmanager
def in_turn() -> Iterator[Engine]:
    """This process, one task after the other, on one thread: the same results, and callbacks can be seen."""
    yield _InTurn()


@contextlib.contextmanager
def processes(workers: int) -> Iterator[Engine]:
    """Fresh processes of this machine, ended with the block, at once if it is left by an error or by Ctrl-C.

    Raises (while mapping):
        DictionaryError: a process died.
    """
    before = set(multiprocessing.active_children())
    with _environment(_ONE_THREAD):
        pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
        try:
            yield _Processes(pool, workers)
        except BaseException:
            for child in set(multiprocessing.active_children()) - before:
                child.terminate()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def ray_cluster(address: str, workers: int) -> Iterator[Engine]:
    """A Ray cluster; its machines must have potserver, and the recordings at the same paths.

    Args:
        address: As `ray.init` takes it; "local" starts a cluster on this machine and ends it with the block.
        workers: Processors of a local cluster.
    Raises:
        DictionaryError: Ray is not installed, there is no cluster, or (while mapping) Ray gave a task up.
    """
    # before the import: Ray reads them there
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        ray: Any = importlib.import_module("ray")
    except ImportError as error:
        raise DictionaryError(f"--ray needs Ray: {how_to_install('ray')} ({error})") from error
    options: dict[str, Any] = {
        "address": address,
        "log_to_driver": False,
        "logging_level": logging.ERROR,
    }
    if address == LOCAL_RAY:
        options |= {
            "num_cpus": workers,
            "object_store_memory": _RAY_OBJECT_STORE_BYTES,
            "include_dashboard": False,
            "_node_ip_address": "127.0.0.1",
        }
    else:
        options["runtime_env"] = {"env_vars": _ONE_THREAD}
    host, _, port = address.rpartition(":")
    try:
        if host and port.isdecimal() and "/" not in host:  # Ray itself would try for minutes
            socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_S).close()
        with _environment(_ONE_THREAD):  # which a local cluster inherits
            ray.init(**options)
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        raise DictionaryError(f"no Ray cluster at {address}: {error}") from error
    try:
        yield _Ray(ray)
    finally:
        ray.shutdown()


class _InTurn:
    def map(self, function: Callable[[T], R], tasks: Iterable[T]) -> Iterator[R]:
        return map(function, tasks)


class _Processes:
    def __init__(self, pool: ProcessPoolExecutor, workers: int) -> None:
        self._pool, self._workers = pool, workers

    def map(self, function: Callable[[T], R], tasks: Iterable[T]) -> Iterator[R]:
        def submit(task: T) -> Any:
            with _interrupts_held():  # a worker that starts now inherits this: Ctrl-C is for us alone
                return self._pool.submit(function, task)

        try:
            yield from in_order(
                submit, lambda future: future.result(), tasks, _TASKS_A_WORKER * self._workers
            )
        except BrokenProcessPool as error:
            raise DictionaryError(
                "a worker process died, perhaps for want of memory: try fewer with --workers"
            ) from error


class _Ray:
    def __init__(self, ray: Any) -> None:
        self._ray = ray

    def map(self, function: Callable[[T], R], tasks: Iterable[T]) -> Iterator[R]:
        ahead = _TASKS_A_WORKER * max(1, int(self._ray.cluster_resources().get("CPU", 1)))
        remote = self._ray.remote(num_cpus=1)(function)
        try:
            yield from in_order(remote.remote, self._ray.get, tasks, ahead)
        except self._ray.exceptions.RayTaskError:
            raise  # a bug of ours; it looks like the error that it wraps
        except self._ray.exceptions.RayError as error:
            raise DictionaryError(f"Ray gave a task up: {error}") from error


def in_order(
    submit: Callable[[T], Any], result_of: Callable[[Any], R], tasks: Iterable[T], ahead: int
) -> Iterator[R]:
    """Hand out tasks, `ahead` at most at a time, and give back their results in order."""
    waiting: deque[Any] = deque()
    for task in tasks:
        waiting.append(submit(task))
        if len(waiting) >= ahead:
            yield result_of(waiting.popleft())
    while waiting:
        yield result_of(waiting.popleft())


@contextlib.contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Variables that processes started inside the block inherit."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C waits until the end of the block; processes that start inside it never get one."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

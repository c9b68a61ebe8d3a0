"""Runs the cases of an experiment side by side, and keeps each as soon as it is finished.

The engine is the interface of `concurrent.futures`: on one machine the standard library's process pool serves, which
needs nothing installed and nothing started, and Dask's scheduler gives the very same interface to a cluster
(`distributed.Client(address).get_executor()`). So one loop runs both, and no cluster code is ours; Ray has that
interface only through add-ons. A case is computed by a worker and saved here: the machines need share no disk.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib.metadata import version
from multiprocessing import resource_tracker
from typing import Any

from ropetrace.errors import ConfigError, RopetraceError, import_extra
from ropetrace.evaluation.experiments import ComputeTimes, Experiment, Settings, SomeCase
from ropetrace.evaluation.run_folder import Result, RunFolder


def check_engine(jobs: int | None, cluster: str | None) -> None:
    """Refuse what `run_cases` would refuse, before anything is measured or written.

    Raises
    ------
    ConfigError
        If the number of jobs or the cluster's address is impossible.
    MissingExtraError
        If a cluster is asked for and Dask is not installed.
    """
    if jobs is not None and jobs < 1:
        raise ConfigError(f"--jobs {jobs}: expected 1 or more")
    if cluster is not None:
        import_extra("distributed", "cluster")
        if re.fullmatch(r"(\w+://)?\S+:[0-9]+", cluster) is None:
            raise ConfigError(f"--cluster {cluster}: expected the address of a Dask scheduler, such as tcp://host:8786")


def run_cases(
    experiment: Experiment[SomeCase, Settings, Result],
    folder: RunFolder[SomeCase, Result],
    cases: Sequence[SomeCase],
    settings: Settings,
    compute_times: ComputeTimes,
    *,
    jobs: int | None = None,
    cluster: str | None = None,
    on_progress: Callable[[int], object] = lambda count: None,
) -> None:
    """Run the cases that are not finished. An interruption or an error keeps those that are.

    Parameters
    ----------
    experiment : Experiment
        Whose cases.
    folder : RunFolder
        Where they are kept; see `Experiment.begin`, which also gives `compute_times`.
    cases : sequence
        What is run.
    settings : dataclass
        The rest.
    compute_times : ComputeTimes
        Of the conditions, if the experiment simulates latency.
    jobs : int, optional
        Cases at a time on this machine; by default as many as it has cores.
    cluster : str, optional
        Address of a Dask scheduler, such as tcp://host:8786. Its workers need ropetrace[sim] of this version.
    on_progress : callable
        Is told about once a second how many more cases are finished, 0 among them.

    Raises
    ------
    RopetraceError
        If a case fails, a worker dies, or the cluster cannot be reached.
    """
    check_engine(jobs, cluster)
    open_cases = [case for case in cases if not folder.run_path(case).exists()]
    if not open_cases:
        return
    # The longest first: so no core is left with one at the end.
    open_cases.sort(key=lambda case: -case.work)
    jobs = min(jobs or len(os.sched_getaffinity(0)), len(open_cases))
    with process_pool(jobs) if cluster is None else dask_executor(cluster) as executor:
        running: dict[Future[Result], SomeCase] = {}
        with without_interrupt():
            for case in open_cases:
                future = executor.submit(_run_case, experiment.run, case, settings, compute_times, version("ropetrace"))
                running[future] = case
        while running:
            done, _ = wait(running, timeout=1, return_when=FIRST_COMPLETED)
            for future in done:
                folder.save(running.pop(future), _result_of(future))
            on_progress(len(done))


def _run_case(
    run: Callable[[SomeCase, Settings, ComputeTimes], Result],
    case: SomeCase,
    settings: Settings,
    compute_times: ComputeTimes,
    wanted: str,
) -> Result:
    """Runs in a worker, perhaps on another machine."""
    if version("ropetrace") != wanted:
        raise ConfigError(f"a worker has ropetrace {version('ropetrace')}, not {wanted}")
    return run(case, settings, compute_times)


def _result_of(future: Future[Result]) -> Result:
    try:
        return future.result()
    except RopetraceError:
        raise
    except BrokenProcessPool:
        raise RopetraceError(
            "a worker was killed, perhaps for want of memory; the finished cases are kept: go on with fewer --jobs"
        ) from None
    except Exception as error:
        raise RopetraceError(f"a case failed ({type(error).__name__}: {error}); the finished cases are kept") from error


@contextmanager
def process_pool(jobs: int) -> Iterator[Executor]:
    """Processes that are spawned, not forked: a fork of a process with threads can hang."""
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), end_with_parent)
    try:
        yield pool
    except BaseException:
        # A case takes minutes: nobody who pressed Ctrl-C waits for it.
        for process in set(multiprocessing.active_children()) - before:
            process.kill()
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler.

    Raises
    ------
    ConfigError
        If no scheduler answers.
    MissingExtraError
        If Dask is not installed.
    """
    distributed = import_extra("distributed", "cluster")
    try:
        client = distributed.Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--cluster {address}: no Dask scheduler answers there: {error}") from None
    with client:
        executor = client.get_executor(pure=False)
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False)
            raise
        executor.shutdown()


@contextmanager
def without_interrupt() -> Iterator[None]:
    """Processes that are started in the block never see Ctrl-C, which a terminal sends to them too."""
    # Started with the first of them, it would give that one back the Ctrl-C (Python 3.11).
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """Let this worker end when its parent is gone, even if that was killed."""

    def follow(parent: Any) -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, args=(multiprocessing.parent_process(),), daemon=True).start()

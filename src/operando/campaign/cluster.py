"""Workers of a Dask cluster: one that runs already, or one that a batch system or Kubernetes starts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from operando.campaign.config import Workers
from operando.campaign.task import Task, perform
from operando.errors import MissingError, OperandoError

_one_at_a_time = threading.Lock()


def perform_alone(values: dict[str, Any]) -> dict[str, Any]:
    """Run a test on a Dask worker, one at a time in a process: drawing the report is no work for several threads."""
    with _one_at_a_time:
        return perform(Task.from_dict(values))


class DaskPool:
    """Workers behind a Dask scheduler, used as local ones are."""

    def __init__(self, client: Any, say: Callable[[str], None]) -> None:
        from distributed import as_completed

        self._client, self._say = client, say
        self._tasks: dict[str, Task] = {}
        self._done = as_completed()

    @property
    def size(self) -> int:
        """Workers there are now: others may come and go."""
        return max(1, len(self._client.scheduler_info(n_workers=-1)["workers"]))

    def submit(self, task: Task) -> None:
        """Have a test run as soon as a worker is free."""
        future = self._client.submit(perform_alone, task.to_dict(), key=f"operando-{task.name}-{task.fingerprint[:16]}", pure=False)
        self._tasks[future.key] = task
        self._done.add(future)

    def next_answer(self) -> tuple[Task, dict[str, Any]]:
        """The next test that ended, and what its worker said of it."""
        from distributed import KilledWorker

        future = next(self._done)
        task = self._tasks.pop(future.key)
        try:
            answer = dict(future.result())
        except KilledWorker:
            answer = {"state": "failed", "reason": "its Dask workers were lost again and again; not enough memory for it?"}
        except Exception as error:
            answer = {"state": "failed", "reason": f"its Dask worker failed: {type(error).__name__}: {error}"}
        future.release()
        return task, answer


@contextmanager
def dask_pool(workers: Workers, say: Callable[[str], None]) -> Iterator[DaskPool]:
    """A pool that ends with the block."""
    try:
        from distributed import Client
    except ImportError:
        raise MissingError("Dask is not installed", where="workers", hint="pip install 'operando[dask]'") from None
    cluster = None if workers.scheduler is not None else start_cluster(workers)
    try:
        try:
            client = Client(workers.scheduler if cluster is None else cluster, timeout=15)
        except (OSError, TimeoutError, ValueError) as error:
            hint = "start it with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`"
            raise OperandoError(f"the Dask scheduler cannot be reached: {error}", where=str(workers.scheduler), hint=hint) from None
        with client:
            if not client.scheduler_info(n_workers=-1)["workers"]:
                say("the Dask cluster has no worker yet: waiting for one")
            yield DaskPool(client, say)
    finally:
        if cluster is not None:
            cluster.close()


def start_cluster(workers: Workers) -> Any:
    """A cluster of so many workers, each of one thread."""
    options = dict(workers.options)
    try:
        if workers.cluster == "slurm":
            from dask_jobqueue import SLURMCluster

            cluster = SLURMCluster(**{"cores": 1, "processes": 1, "memory": "2GB", **options})
            cluster.scale(jobs=workers.jobs)
        else:
            from dask_kubernetes.operator import KubeCluster

            cluster = KubeCluster(**{"name": "operando", **options})
            cluster.scale(workers.jobs)
    except ImportError as error:
        extra = f"pip install 'operando[{workers.cluster}]'"
        raise MissingError(f"{error.name} is not installed", where="[workers] cluster", hint=extra) from None
    return cluster

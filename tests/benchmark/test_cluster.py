"""A Dask cluster of two workers that loses one midway."""

import os
import signal
import threading
import warnings
from pathlib import Path

import cloudpickle
import distributed
import numpy as np
import pytest

from oat_gym.benchmark.runner import run
from oat_gym.errors import ConfigurationError
from tests.benchmark import tiny
from tests.benchmark.test_runner import assert_same, contents, plan_of

pytestmark = pytest.mark.filterwarnings("ignore")  # of Dask's own, when a worker is lost


def test_a_scheduler_that_does_not_answer_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="No Dask scheduler answers"):
        run(plan_of("none"), tmp_path, scheduler="tcp://127.0.0.1:1", catalog=tiny.CATALOG)


def test_a_cluster_that_loses_a_worker_finishes_with_the_same_cells(tmp_path: Path) -> None:
    plan = plan_of("jittering", seeds=tuple(range(6)))
    cloudpickle.register_pickle_by_value(tiny)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        cluster = distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
        )
        try:
            done: list[str] = []
            killed = threading.Event()

            def listen(pace: object, report: object) -> None:
                done.append(str(report))
                if len(done) < 3 or killed.is_set():  # two jobs of twelve are finished
                    return
                known = cluster.scheduler.workers
                busy = [each.pid for each in cluster.workers.values() if known[each.worker_address].processing]
                if busy:
                    os.kill(busy[0], signal.SIGKILL)
                    killed.set()

            run(plan, tmp_path / "cluster", scheduler=cluster.scheduler_address, catalog=tiny.CATALOG, listen=listen)
            assert killed.is_set()
            assert len(done) == 1 + len(plan.jobs)
        finally:
            cluster.close(timeout=5)
            cloudpickle.unregister_pickle_by_value(tiny)
    assert plan.open_jobs(tmp_path / "cluster") == ()
    run(plan, tmp_path / "here", catalog=tiny.CATALOG)
    there = contents(tmp_path / "cluster", plan)
    assert_same(contents(tmp_path / "here", plan), there)
    assert all(np.isfinite(values).all() for values, _ in there.values())

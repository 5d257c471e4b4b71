"""Studies on a Dask cluster of real processes: the bytes of a run in one process, whatever ends on the way."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from kros.core.errors import DataError, KrosError
from kros.core.files import TEMPORARY
from kros.core.work import Progress
from kros.data import Channel, EpisodeKey, Role, Unit, from_arrays, write_parquet
from kros.data.population import OUTLIERS
from kros.study import run as run_study
from kros.study.config import Stage, load_config
from kros.study.engine.executors import open_executor

dask = pytest.importorskip("dask", reason="Dask is not installed: pip install 'kros[dask]'")
distributed = pytest.importorskip("distributed", reason="Dask is not installed: pip install 'kros[dask]'")
threadpoolctl = pytest.importorskip("threadpoolctl", reason="threadpoolctl is not installed: pip install 'kros[dask]'")
pytestmark = pytest.mark.xdist_group("cluster")

STUDY = """
[data]
source = "recordings"
reader = "parquet"
prepare = [{ step = "scale", channels = ["x"], factor = 2.0 }]  # so that workers write into the run folder
[identify]
refine = false
alpha = 0.0
"""
DEADLINE_S = 60  # for processes to start; nothing waits that long on a machine with time


class Cluster:
    """A scheduler and workers, each a process of its own, started when they are needed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.scheduler, self.workers = folder, None, []

    def start(self, workers: int) -> str:
        """Bring a live scheduler and its workers; return the address."""
        place = self.folder / "scheduler.json"
        if self.scheduler is None or self.scheduler.poll() is not None:
            self.stop()
            place.unlink(missing_ok=True)
            self.scheduler = self._run("scheduler", "--host", "127.0.0.1", "--port", "0")
        self.workers = [w for w in self.workers if w.poll() is None]
        while len(self.workers) < workers:
            self.workers.append(self._run("worker", "--no-nanny", "--nthreads", "2", "--local-directory", self.folder))
        address = until(lambda: json.loads(place.read_text())["address"])
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=DEADLINE_S)
        return address

    def _run(self, what: str, *options: object) -> subprocess.Popen[bytes]:
        own = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "2")
        own["DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES"] = "1"
        path = os.pathsep.join((str(Path(__file__).parent), *filter(None, sys.path)))
        fixed = ("--no-dashboard", "--scheduler-file", "scheduler.json")
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", *fixed, *map(str, options)]
        with (self.folder / f"{what}.log").open("ab") as log:
            return subprocess.Popen(
                command, cwd=self.folder, env={**os.environ, **own, "PYTHONPATH": path}, stdout=log, stderr=log
            )

    def stop(self) -> None:
        """End every process."""
        for process in (*self.workers, self.scheduler):
            if process is not None:
                process.kill()
                process.wait()
        self.workers = []


def until(ask):
    """Return what `ask` returns as soon as it does without an error."""
    deadline = time.monotonic() + DEADLINE_S
    while True:
        try:
            return ask()
        except (OSError, ValueError, KeyError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.02)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    yield made
    made.stop()


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A study of four machines and one that is not stable, of the group of outliers."""
    rng, data = np.random.default_rng(4), {}
    for unit in range(5):
        for episode in range(2):
            x, u = np.zeros((80, 2)), rng.standard_normal(80)
            for k in range(79):
                x[k + 1] = [0.9 * x[k, 0] + 0.1 * x[k, 1], (0.8 + 0.01 * unit if unit < 4 else 1.05) * x[k, 1] + u[k]]
            data[EpisodeKey(str(unit), "default", str(episode))] = np.column_stack([x, u])
    channels = (Channel("x", Role.STATE, measured=True), Channel("v", Role.STATE), Channel("u", Role.INPUT))
    folder = tmp_path_factory.mktemp("study")
    write_parquet(from_arrays(data, channels, 0.01, units=(Unit("4", OUTLIERS),)), folder / "recordings")
    (folder / "study.toml").write_text(STUDY)
    return folder / "study.toml"


@pytest.fixture(scope="module")
def wanted(study, tmp_path_factory):
    """What the study leaves where it runs in one process."""
    out = tmp_path_factory.mktemp("wanted") / "run"
    with threadpoolctl.threadpool_limits(1):
        run_study(load_config(study), out, until=Stage.IDENTIFY)
    return left_in(out)


def left_in(out: Path) -> dict[str, bytes]:
    """All files of a run without the manifest and what artefacts hold, which say how long stages took; results of units are from workers."""
    files = [f for f in out.rglob("*") if f.is_file() and f.name not in ("manifest.json", "artefact.json")]
    # the next run removes what a worker was writing that was killed
    files = [f for f in files if not f.parent.name.startswith(TEMPORARY)]
    found = {str(f.relative_to(out)): f.read_bytes() for f in files}
    metrics = json.loads(found.pop("metrics.json"))
    metrics.pop("timing_s")
    return found | {"metrics.json": json.dumps(metrics).encode()}


class Ends(Progress):
    """Ends a process when the first piece of a map in identification is done."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process, self.now = process, ""

    def start(self, stage: str, total: int | None) -> None:
        self.now = stage

    def advance(self) -> None:
        if self.now.startswith("identify") and self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def square(x: int) -> int:
    return x * x


def threads(_: int) -> set[int]:
    """Threads of every library for linear algebra in this process, NumPy's among them."""
    return {pool["num_threads"] for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"}


def refuse(x: int) -> int:
    raise DataError(f"Unit {x}: is not finite.")


def missing(folder: Path) -> str:
    return (folder / "nowhere").read_text()


def alone(_: int, folder: Path) -> bool:
    """Whether no other task runs in this process beside this one."""
    mark = folder / str(os.getpid())
    try:
        mark.touch(exist_ok=False)
    except FileExistsError:
        return False
    time.sleep(0.05)
    mark.unlink()
    return True


def die(_: int) -> None:
    os._exit(9)


def test_tasks_run_alone_with_one_thread_and_their_errors_come_back(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr("kros.study.engine.executors._BATCHES", 4)
    address = cluster.start(2)
    with open_executor(scheduler=address) as executor:
        assert list(executor(square, range(30))) == [x * x for x in range(30)]
        assert list(executor(square, [])) == []
        assert set().union(*executor(threads, range(4))) == {1}
        assert all(executor(partial(alone, folder=tmp_path), range(8)))
        with pytest.raises(DataError, match="Unit 7: is not finite"):
            list(executor(refuse, [7]))
        with pytest.raises(KrosError, match="nowhere; recordings and run folder must be in a shared folder"):
            list(executor(missing, [tmp_path]))
    if len(os.sched_getaffinity(0)) > 1:  # else one thread is all there is
        with distributed.Client(address, set_as_default=False) as client:
            assert client.submit(threads, 0).result() != {1}


def test_workers_have_the_same_kros(cluster, monkeypatch):
    monkeypatch.setattr("kros.study.engine.executors.code_key", lambda: "another")
    with (
        open_executor(scheduler=cluster.start(1)) as executor,
        pytest.raises(KrosError, match="install the same version on every worker"),
    ):
        list(executor(square, [0]))


def test_a_study_with_a_worker_killed_half_way_leaves_the_same_bytes(cluster, study, wanted, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # workers are elsewhere
    address = cluster.start(2)
    ends = Ends(cluster.workers[0])
    run_study(load_config(study), "run", until=Stage.IDENTIFY, scheduler=address, progress=ends)
    assert ends.process.poll() is not None
    assert left_in(tmp_path / "run") == wanted
    units = json.loads(wanted["metrics.json"])["units"]
    assert [row["status"].partition(",")[0] for row in units] == ["ok"] * 4 + ["unstable"]


def test_a_run_whose_scheduler_is_lost_says_so_and_goes_on_with_another(cluster, study, wanted, kros, tmp_path):
    address = cluster.start(1)
    ends = Ends(cluster.scheduler)
    with pytest.raises(KrosError, match=r"connection was lost.*the same command goes on"):
        run_study(load_config(study), tmp_path / "run", until=Stage.IDENTIFY, scheduler=address, progress=ends)
    again = kros("run", study, "--out", tmp_path / "run", "--until", "identify", "--scheduler", cluster.start(1))
    assert again.exit_code == 0, again.output
    assert re.search(r"read +unchanged", again.stderr)
    assert not re.search(r"identify +unchanged", again.stderr)
    assert left_in(tmp_path / "run") == wanted


def test_work_that_ends_every_worker_is_given_up(cluster):
    with open_executor(scheduler=cluster.start(2)) as executor, pytest.raises(KrosError, match="ended several workers"):
        list(executor(die, [0]))


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense"])
def test_an_address_where_nothing_answers_leaves_no_folder(address, kros, study, tmp_path):
    with dask.config.set({"distributed.comm.timeouts.connect": "0.2s"}):
        result = kros("run", study, "--out", tmp_path / "run", "--scheduler", address)
    assert result.exit_code == 2
    assert f"--scheduler {address}: no Dask scheduler of this version answers" in result.stderr
    assert not (tmp_path / "run").exists()

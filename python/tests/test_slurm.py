"""Ensembles over dask-jobqueue on a Slurm of one node, which is started here, in a folder of its own."""

import getpass
import os
import random
import shutil
import signal
import socket
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from unittest import mock

import pandas as pd
import pytest
from distributed import Client

from orbitcal import ensemble
from orbitcal.ensemble import store

PATH = os.environ["PATH"] + ":/usr/sbin"  # where Debian has the daemons
MISSING = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if not shutil.which(name, path=PATH)]
pytestmark = pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)} (make slurm installs them)")

SEEDS = range(40)

# the node is said to have what two workers ask for, whatever this machine has
CONFIG = """
ClusterName=test
SlurmctldHost=localhost
SlurmctldPort={controller}
SlurmdPort={node}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
MpiDefault=none
NodeName=localhost CPUs=2 RealMemory=4000
PartitionName=test Nodes=ALL Default=YES
"""


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    """The folder of a Slurm with one node of two cores."""
    folder = tmp_path_factory.mktemp("slurm")
    config = folder / "slurm.conf"
    config.write_text(CONFIG.format(folder=folder, user=getpass.getuser(), controller=_port(), node=_port()))
    (folder / "state").mkdir()
    (folder / "munge.key").write_bytes(os.urandom(128))
    (folder / "munge.key").chmod(0o600)
    files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
    own = [f"--{option}={folder}/munge.{name}" for option, name in files.items()]
    with mock.patch.dict(os.environ, SLURM_CONF=str(config), PATH=PATH), ExitStack() as stack:
        # by force, as other users cannot reach the socket
        stack.enter_context(_daemon("munged", "--foreground", "--force", *own))
        stack.enter_context(_daemon("slurmctld", "-D"))
        stack.enter_context(_daemon("slurmd", "-D", "-N", "localhost"))
        _until(lambda: _says("sinfo", "--noheader", "--format=%t") == ["idle"])
        yield folder
        _until(lambda: not _jobs())


@pytest.fixture
def client(slurm):
    """Two jobs of one worker."""
    handler = signal.getsignal(signal.SIGINT)
    from dask_jobqueue import SLURMCluster

    signal.signal(signal.SIGINT, handler)  # its import has Ctrl-C end the process, that of the tests after this one too

    with (
        SLURMCluster(
            cores=1,
            processes=1,
            memory="1GB",
            interface="lo",
            log_directory=slurm,
            scheduler_options={"dashboard_address": ":0"},
        ) as cluster,
        Client(cluster) as client,
    ):
        cluster.scale(jobs=2)
        client.wait_for_workers(2, timeout=120)
        yield client


@pytest.mark.parametrize("how", [[], ["--signal=KILL", "--full"]], ids=["cancelled", "killed"])
def test_a_job_that_ends_halfway_changes_no_bit(client, how, tmp_path, monkeypatch):
    """`scancel` asks the worker to stop first; a signal to all of a job is as if its node had died."""
    monkeypatch.setattr(store, "ROWS", 1)  # a part after each row, so that halfway is known

    def walk(seed):
        time.sleep(0.2)
        draws = random.Random(seed)
        return {"end": sum(draws.gauss(0, 1) for _ in range(1000))}

    def cancel():
        _until(lambda: len(ensemble.costs(tmp_path / "slurm")) >= len(SEEDS) / 2)
        first, second = _jobs()
        subprocess.run(["scancel", *how, first], check=True)
        _until(lambda: _jobs() == [second])

    with ThreadPoolExecutor() as pool:
        cancelled = pool.submit(cancel)
        table = ensemble.run(walk, SEEDS, tmp_path / "slurm", client=client, progress=False)
        cancelled.result()
    here = ensemble.run(walk, SEEDS, tmp_path / "here", workers=2, progress=False)
    pd.testing.assert_frame_equal(table, here, check_exact=True)
    assert list(table["seed"]) == list(SEEDS)
    rows = ensemble.costs(tmp_path / "slurm")["worker"].value_counts()
    assert len(rows) == 2 and rows.min() < len(SEEDS) / 2


def _jobs():
    """The jobs that have not ended, by number."""
    return sorted(_says("squeue", "--noheader", "--format=%i"), key=int)


def _says(*command):
    return subprocess.run(command, capture_output=True, text=True).stdout.split()


def _until(holds):
    end = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


@contextmanager
def _daemon(*command):
    with subprocess.Popen(command) as process:
        try:
            yield
        finally:
            process.terminate()


def _port():
    with socket.socket() as one:
        one.bind(("localhost", 0))
        return one.getsockname()[1]

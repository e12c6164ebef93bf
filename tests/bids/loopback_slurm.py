"""A Slurm of one node on this machine that listens only on loopback (Debian packages slurm-wlm and munge)."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scancel")

CONF = """ClusterName=loopback
SlurmctldHost=localhost(127.0.0.1)
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
SlurmUser=root
SlurmctldPort=16817
SlurmdPort=16818
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=1
JobAcctGatherParams=OverMemoryKill
SchedulerParameters=sched_interval=1,batch_sched_delay=0
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
ReturnToService=2
SlurmdParameters=config_overrides
KillWait=5
NodeName=localhost NodeAddr=127.0.0.1 CPUs={cores} RealMemory={memory_mb} State=UNKNOWN
PartitionName=quick Nodes=localhost Default=YES MaxTime=60 State=UP
"""


def missing() -> str | None:
    """The reason why Slurm cannot run here; None if it can."""
    absent = [name for name in PROGRAMS if shutil.which(name) is None]
    if absent:
        return f"{', '.join(absent)} not found; apt-get install slurm-wlm munge"
    return None if os.geteuid() == 0 else "slurmd starts processes of others: only root may"


@contextlib.contextmanager
def loopback_slurm(folder: Path, cores: int = 2, memory_mb: int = 4000) -> Iterator[None]:
    """Context in which Slurm runs; SLURM_CONF directs its commands to it.

    Args:
        folder: for its state and logs; users other than root may enter it.
        cores: stated cores of its node, which need not exist.
        memory_mb: of its node.
    """
    folder.mkdir(parents=True, mode=0o755)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    conf, key = folder / "slurm.conf", folder / "munge.key"
    conf.write_text(CONF.format(folder=folder, cores=cores, memory_mb=memory_mb))
    key.write_bytes(os.urandom(128))
    key.chmod(0o400)
    daemons: list[subprocess.Popen[bytes]] = []
    with pytest.MonkeyPatch.context() as patch, (folder / "daemons.log").open("wb") as log:
        patch.setenv("SLURM_CONF", str(conf))
        munge = ["munged", "--foreground", "--force", f"--socket={folder}/munge.socket", f"--key-file={key}"]
        munge += [f"--{kind}-file={folder}/munge.{kind}" for kind in ("pid", "log", "seed")]
        lines = [
            munge,
            ["slurmctld", "-D", "-c", "-f", str(conf)],
            ["slurmd", "-D", "-N", "localhost", "-f", str(conf)],
        ]
        try:
            for line in lines:
                daemons.append(subprocess.Popen(line, stdout=log, stderr=log))
                time.sleep(0.5)
            _wait_until_idle(daemons, folder)
            yield
        finally:
            for daemon in reversed(daemons):
                daemon.send_signal(signal.SIGTERM)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    daemon.wait(15)
                daemon.kill()
                daemon.wait()


def _wait_until_idle(daemons: list[subprocess.Popen[bytes]], folder: Path) -> None:
    until_s = time.monotonic() + 60
    while time.monotonic() < until_s:
        assert all(daemon.poll() is None for daemon in daemons), (folder / "daemons.log").read_text()
        said = subprocess.run(["sinfo", "--noheader", "--format=%T"], capture_output=True, text=True, check=False)
        if said.stdout.strip() == "idle":
            return
        time.sleep(0.5)
    pytest.fail((folder / "daemons.log").read_text()[-2000:] or "Slurm did not start")

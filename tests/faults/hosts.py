"""Machines of a small network, made of Linux namespaces, for tests that break the network.

A machine has its own network, processes, host name, `/tmp` and `/dev/shm`, and sees the rest of
this machine's disk read-only. The cables end in this process, which forwards the frames, so a test
can cut or slow down a machine's cable. The kernel ends a machine when the process that created it
ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import itertools
import os
import random
import select
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import psutil

BIN = Path(sys.executable).parent
ROOT = Path(__file__).resolve().parents[2]
"""The checkout with the installed package, which a machine sees even if it is below `/tmp`."""
DELAY_SECONDS, LOSS = 0.1, 0.01
"""Properties of a slow cable, for each frame in either direction."""

_TUNSETIFF, _TAP_WITHOUT_HEADER = 0x400454CA, 0x1002
_UNSHARE = ["unshare", "--net", "--mount", "--pid", "--uts", "--fork", "--kill-child"]
_INIT = """
set -e
mount -o remount,bind,ro /
mount --bind {root} /mnt
mount -t tmpfs tmpfs /tmp
mkdir -p {root}
mount --bind /mnt {root}
mount -t tmpfs tmpfs /dev/shm
mkdir /tmp/home
hostname {name}
exec 3<&0
cat <&3 &
echo ready
wait
"""
"""The first process of a machine; it ends with its input, and reaps orphans."""


class Network(threading.Thread):
    """A switch between machines; `close` also ends the machines."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.cut: set[Host] = set()
        """Machines that no frame leaves or reaches."""
        self.slow: set[Host] = set()
        """Machines with `DELAY_SECONDS` and `LOSS`."""
        self.hosts: dict[int, Host] = {}
        self._late: list[tuple[float, int, int, bytes]] = []
        self._closed = False

    def run(self) -> None:
        """Forward frames of the machines that exist now, until `close`."""
        chance, order = random.Random(0), itertools.count()
        sources = {host.wire: host for host in self.hosts.values()}
        while not self._closed:
            due = self._late[0][0] - time.monotonic() if self._late else 0.1
            for wire in select.select(list(sources), [], [], min(0.1, max(0.0, due)))[0]:
                try:
                    source, frame = sources[wire], os.read(wire, 65536)
                except OSError:  # its machine has ended, by Ctrl-C before `close`
                    continue
                for target in self._targets(source, frame):
                    if {source, target} & self.cut:
                        continue
                    if not {source, target} & self.slow:
                        self._deliver(target.wire, frame)
                    elif chance.random() >= LOSS:
                        late = (time.monotonic() + DELAY_SECONDS, next(order), target.wire, frame)
                        heapq.heappush(self._late, late)
            while self._late and self._late[0][0] <= time.monotonic():
                self._deliver(*heapq.heappop(self._late)[2:])

    def _targets(self, source: Host, frame: bytes) -> list[Host]:
        if frame[:6] == b"\xff" * 6:
            return [host for host in self.hosts.values() if host is not source]
        known = frame[:5] == _mac(0)[:5] and frame[5] in self.hosts
        return [self.hosts[frame[5]]] if known else []

    def _deliver(self, wire: int, frame: bytes) -> None:
        with contextlib.suppress(OSError):  # its machine is about to end
            os.write(wire, frame)

    def close(self) -> None:
        """End the machines and their processes."""
        self._closed = True
        if self.is_alive():
            self.join()
        for host in self.hosts.values():
            host.close()


def _mac(number: int) -> bytes:
    return bytes([2, 0, 0, 0, 0, number])


class Host:
    """A machine whose programs get `environment`.

    Raises:
        OSError: This machine does not allow namespaces or network devices.
    """

    def __init__(self, network: Network, name: str, environment: Mapping[str, str]) -> None:
        number = len(network.hosts) + 1
        self.address = f"10.77.0.{number}"
        self.environment = {"PATH": f"{BIN}:{os.environ['PATH']}", "HOME": "/tmp/home"}
        self.environment |= environment
        device = f"music{os.getpid()}"  # renamed when it is in the machine
        self._started: list[subprocess.Popen[str]] = []
        self.wire = os.open("/dev/net/tun", os.O_RDWR)
        self._life = subprocess.Popen(
            [*_UNSHARE, "--mount-proc", "sh", "-c", _INIT.format(name=name, root=ROOT)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            assert self._life.stdout is not None
            assert self._life.stderr is not None
            if self._life.stdout.readline() != "ready\n":
                raise OSError(self._life.stderr.read().strip())
            self._init, *_ = self._own = [
                process.pid for process in psutil.Process(self._life.pid).children(recursive=True)
            ]
            fcntl.ioctl(
                self.wire, _TUNSETIFF, struct.pack("16sH", device.encode(), _TAP_WITHOUT_HEADER)
            )
            subprocess.run(["ip", "link", "set", device, "netns", str(self._init)], check=True)
            mac = _mac(number).hex(":")
            self.call(
                f"ip link set {device} name eth0 address {mac}; ip link set lo up; "
                f"ip addr add {self.address}/24 dev eth0; ip link set eth0 up"
            )
        except BaseException:
            self.close()
            raise
        network.hosts[number] = self

    def path(self, path: str) -> Path:
        """A path of this machine, for programs outside it."""
        return Path(f"/proc/{self._init}/root{path}")

    def start(self, script: str, **options: Any) -> subprocess.Popen[str]:
        """Start a shell script; without `options` its output is written to `/tmp/log`."""
        if not options:
            script = f"exec >>/tmp/log 2>&1; {script}"
        spaces = [f"--target={self._init}", "--net", "--mount", "--pid", "--uts"]
        command = ["nsenter", *spaces, "sh", "-c", script]
        process = subprocess.Popen(command, env=self.environment, text=True, **options)
        self._started.append(process)
        return process

    def call(self, script: str) -> str:
        """Run a shell script to its successful end; returns its output."""
        process = self.start(script, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        output = process.communicate(timeout=300)[0]
        if process.returncode:
            raise OSError(output)
        return output

    def kill(self, name: str = "") -> None:
        """Kill the programs called `name`, or all of them."""
        here = Path(f"/proc/{self._init}/ns/pid").readlink()
        for process in psutil.process_iter():
            with contextlib.suppress(OSError, psutil.NoSuchProcess):
                inside = Path(f"/proc/{process.pid}/ns/pid").readlink() == here
                if inside and process.pid not in self._own and name in ("", process.name()):
                    process.kill()

    def close(self) -> None:
        """End the machine; the kernel ends its other processes and removes the rest."""
        for process in (self._life, *self._started):
            with process:
                process.kill()
        os.close(self.wire)

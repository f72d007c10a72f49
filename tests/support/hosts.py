"""Hosts on a network of their own, in network namespaces: cables that can be cut, computers that can crash.

Knows namespaces, cables and programs; knows no Modbus. Needs Linux, root and ``ip`` of iproute2.

1. Every name holds the number of this process, and everything that was made is removed with the network, whatever has
   happened. Only programs that a host has started are ended, by their handles.
2. A cut cable takes what is sent and brings nothing: neither end hears of the other any more. A host that crashes says
   nothing to any other: its cable goes first, then its programs, then its whole stack with every connection in it.
3. A host that boots again is the same one to its network: same address, same hardware address, no memory.
"""

import os
import shutil
import subprocess
import sys
from contextlib import suppress
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Self

from told_program import Program

_numbers = count(1)


def why_not() -> str:
    """Why there can be no such network here; empty where there can."""
    if sys.platform != "linux":
        return "network namespaces are Linux'"
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "there is no ip command (Debian: iproute2)"
    probe = f"busway-{os.getpid()}-probe"
    made = subprocess.run(["ip", "netns", "add", probe], capture_output=True, text=True, check=False)
    if made.returncode != 0:
        return f"this system makes no network namespace: {made.stderr.strip()}"
    _ip("netns", "del", probe)
    return ""


class Network:
    """A switch with hosts on it; a context manager that removes all of it."""

    def __init__(self) -> None:
        self.name = f"busway-{os.getpid()}-{next(_numbers)}"
        self.switch = f"{self.name}-switch"
        self._hosts: list[Host] = []

    def __enter__(self) -> Self:
        _ip("netns", "add", self.switch)
        try:
            _ip("-n", self.switch, "link", "add", "bridge", "type", "bridge")
            _ip("-n", self.switch, "link", "set", "bridge", "up")
        except BaseException:
            self._remove()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._remove()

    def host(self) -> "Host":
        """One more host, running; the first is 10.77.0.1."""
        host = Host(self, len(self._hosts) + 1)
        self._hosts.append(host)
        host.boot()
        return host

    def _remove(self) -> None:
        for host in self._hosts:
            host.crash()
        _ip("netns", "del", self.switch)


class Host:
    """A computer on a `Network`.

    Attributes:
        address: its IPv4 address.
    """

    def __init__(self, network: Network, number: int) -> None:
        self.address = f"10.77.0.{number}"
        self._switch = network.switch
        self._namespace = f"{network.name}-{number}"
        self._port = f"port{number}"
        self._hardware = f"02:00:00:77:00:{number:02x}"
        self._programs: list[Program] = []
        self._runs = False

    def boot(self) -> None:
        """Come up, with the cable in."""
        _ip("netns", "add", self._namespace)
        self._runs = True
        peer = ("peer", "name", "eth0", "address", self._hardware, "netns", self._namespace)
        _ip("-n", self._switch, "link", "add", self._port, "type", "veth", *peer)
        _ip("-n", self._switch, "link", "set", self._port, "master", "bridge", "up")
        _ip("-n", self._namespace, "link", "set", "lo", "up")
        _ip("-n", self._namespace, "addr", "add", f"{self.address}/24", "dev", "eth0")
        _ip("-n", self._namespace, "link", "set", "eth0", "up")

    def crash(self) -> None:
        """Be gone from one moment to the next, without a word."""
        if not self._runs:
            return
        self._runs = False
        with suppress(subprocess.CalledProcessError):  # a boot that failed left none
            _ip("-n", self._switch, "link", "del", self._port)
        for program in self._programs:
            program.kill()
        self._programs.clear()
        _ip("netns", "del", self._namespace)

    def cut(self) -> None:
        """Pull the cable out."""
        _ip("-n", self._switch, "link", "set", self._port, "down")

    def mend(self) -> None:
        """Put the cable in again."""
        _ip("-n", self._switch, "link", "set", self._port, "up")

    def drop_to(self, address: str, *, dropped: bool) -> None:
        """Throw away all that this host sends to an address, while what comes from there arrives; or no longer."""
        _ip("-n", self._namespace, "route", "add" if dropped else "del", "blackhole", f"{address}/32")

    @property
    def namespace(self) -> str:
        """The name of its network namespace."""
        return self._namespace

    def start(self, script: Path, *arguments: str) -> "Program":
        """Start a Python program on this host; it gets ready while others do."""
        program = Program(["ip", "netns", "exec", self._namespace, sys.executable, str(script), *arguments])
        self._programs.append(program)
        return program

    def ready(self) -> None:
        """Wait until everything that was started here is ready."""
        for program in self._programs:
            program.ready()


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], capture_output=True, text=True, check=True)

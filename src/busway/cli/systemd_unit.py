"""Generates the systemd unit file that runs a gateway.

Knows directives of systemd (systemd.service(5), systemd.exec(5)) and what a gateway needs of the system; opens nothing.

1. The unit permits what the gateway's configuration needs, and nothing else: the serial group only for serial ports,
   low port numbers only if it listens on one.
2. systemd waits ``drain`` seconds and a little longer for the gateway to end.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ..apps.gateway.gateway_plan import GatewayPlan
from ..options.endpoints import Endpoint, parse_endpoint
from ..server.bound_sockets import is_loopback

_LOWEST_FREE_PORT: Final = 1024
_STOP_MARGIN: Final = 5
_WATCHDOG_SECONDS: Final = 30
_RUNTIME_DIRECTORY: Final = "busway"


@dataclass(frozen=True, slots=True)
class ServiceUnit:
    """The contents of a systemd unit file for a gateway: command, rights and paths.

    Attributes:
        command: words of the command line; the first is an absolute path. ``--control`` and its value are two words.
        plan: listeners and upstreams of the gateway; the rights of the service follow from them.
        drain: seconds that the gateway may take to answer open requests at its end.
        written: absolute paths of folders that the gateway writes into, such as that of the audit log.
        name: name of the control socket, ``/run/busway/NAME.sock``, unless the command has ``--control``.
    """

    command: Sequence[str]
    plan: GatewayPlan
    drain: float
    written: Sequence[str] = ()
    name: str = "gateway"

    def text(self) -> str:
        """Return the text of the systemd unit file."""
        return "\n".join(
            (
                "[Unit]",
                "Description=Modbus gateway (busway)",
                "Wants=network-online.target",
                "After=network-online.target",
                "StartLimitIntervalSec=0",
                "",
                "[Service]",
                *self._service(),
                "",
                "# It needs no more of the system than this.",
                *self._confinement(),
                "",
                "[Install]",
                "WantedBy=multi-user.target",
                "",
            )
        )

    def _service(self) -> Iterator[str]:
        yield "Type=notify"
        words = list(self.command)
        end = words.index("--") if "--" in words else len(words)  # what follows is no option
        if "--control" not in words[:end]:
            words[end:end] = ["--control", f"/run/{_RUNTIME_DIRECTORY}/{self.name}.sock"]
        yield f"ExecStart={' '.join(map(quoted, words))}"
        yield "ExecReload=/bin/kill -HUP $MAINPID"
        yield "Restart=always"
        yield "RestartSec=1"
        yield "# 2: the file is invalid; a restart would not help."
        yield "RestartPreventExitStatus=2"
        yield f"TimeoutStopSec={int(self.drain) + _STOP_MARGIN}"
        yield f"WatchdogSec={_WATCHDOG_SECONDS}"
        yield f"RuntimeDirectory={_RUNTIME_DIRECTORY}"
        yield "RuntimeDirectoryPreserve=yes"
        yield f"StateDirectory={_RUNTIME_DIRECTORY}"

    def _confinement(self) -> Iterator[str]:
        yield "DynamicUser=yes"
        if self._has_ports:
            yield "SupplementaryGroups=dialout"
        else:
            yield "PrivateDevices=yes"
        capability = "CAP_NET_BIND_SERVICE" if self._needs_low_port else ""
        yield f"CapabilityBoundingSet={capability}"
        if capability:
            yield f"AmbientCapabilities={capability}"
        yield "NoNewPrivileges=yes"
        yield "ProtectSystem=strict"
        yield f"ProtectHome={'read-only' if self._is_at_home else 'yes'}"
        for folder in self.written:
            yield f"ReadWritePaths={quoted(folder)}"
        yield from _ALWAYS

    @property
    def _places(self) -> list[Endpoint]:
        return [parse_endpoint(listener.settings.endpoint) for listener in self.plan.listeners]

    @property
    def _has_ports(self) -> bool:
        return any(
            place.carrier == "serial" for place in (*self._places, *(one.link.endpoint for one in self.plan.upstreams))
        )

    @property
    def _needs_low_port(self) -> bool:
        network = [place for place in self._places if place.carrier != "serial"]
        if any(place.port and place.port < _LOWEST_FREE_PORT for place in network):
            return True
        beside = self.plan.server.get("standard_port")  # 502, beside another port that was chosen
        plain = [place for place in network if place.scheme == "tcp" and place.port]
        return bool(plain) if beside else beside is None and any(not is_loopback(place.url) for place in plain)

    @property
    def _is_at_home(self) -> bool:
        return any(word.startswith(("/home/", "/root/", "/run/user/")) for word in (*self.command, *self.written))


_ALWAYS: Final = (
    "PrivateTmp=yes",
    "ProtectControlGroups=yes",
    "ProtectHostname=yes",
    "ProtectKernelLogs=yes",
    "ProtectKernelModules=yes",
    "ProtectKernelTunables=yes",
    "RestrictAddressFamilies=AF_INET AF_INET6 AF_UNIX AF_NETLINK",
    "RestrictNamespaces=yes",
    "RestrictSUIDSGID=yes",
    "LockPersonality=yes",
    "SystemCallArchitectures=native",
    "SystemCallFilter=@system-service",
    "UMask=0077",
)


def program() -> list[str]:
    """Return the words that start this program: the path of ``busway``, else that of Python and ``-m busway``."""
    command = Path(sys.executable).with_name("busway")
    return [str(command)] if command.exists() else [sys.executable, "-m", "busway"]


def quoted(word: str) -> str:
    """Return a word of a command line, escaped and quoted for systemd (systemd.service(5), "Command lines")."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"' if not word or set(word) & set(" \t\"'\\;") else escaped

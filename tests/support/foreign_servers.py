"""Servers that sinks send to, from Debian's packages: started on a free port of loopback, stopped, started again.

A test is skipped where a server is not installed, or fails (`missing_peers`).
"""

import contextlib
import os
import pwd
import random
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from missing_peers import needed

READY_SECONDS = 60.0
_CHANCE = random.SystemRandom()  # tests that run beside this one must not choose the same
_given: set[int] = set()
_giving = threading.Lock()


def free_port() -> int:
    """A port for a program that binds it later, below those from which the system takes clients' ports meanwhile.

    It is given once: until its program has bound it, the system would call it free. Each worker of pytest has its own.
    """
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % 4
    while True:
        port = _CHANCE.randrange(10_000, 32_000, 4) + worker
        with _giving:
            if port in _given:
                continue
            _given.add(port)
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind(("127.0.0.1", port))
            return port


class ForeignServer:
    """One server on one port, which stays the same over a restart."""

    def __init__(
        self, command: Sequence[str], port: int, *, user: str | None = None, stop: int = signal.SIGTERM
    ) -> None:
        self.port = port
        self.command, self._user, self._stop = list(command), user, stop
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> Self:
        """Start it, and wait until it accepts connections."""
        self._process = subprocess.Popen(
            self.command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            user=self._user,
            group=self._user,
            cwd="/",
        )
        until = time.monotonic() + READY_SECONDS
        while time.monotonic() < until:
            assert self._process.poll() is None, f"{self.command} has ended"
            try:
                socket.create_connection(("127.0.0.1", self.port), 1).close()
                return self
            except OSError:
                time.sleep(0.02)
        raise AssertionError(f"{self.command} is not ready")

    def stop(self) -> None:
        """End it, and wait until it has."""
        if self._process is not None:
            self._process.send_signal(self._stop)
            try:
                self._process.wait(10)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait(10)
            self._process = None

    def reload(self) -> None:
        """Let it read its configuration again."""
        assert self._process is not None
        self._process.send_signal(signal.SIGHUP)

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *exception: object) -> None:
        self.stop()


def mosquitto(folder: Path, *lines: str) -> ForeignServer:
    """An MQTT broker that keeps nothing but what is retained in memory; ``lines`` are of its configuration."""
    program, port = needed("mosquitto"), free_port()
    config = folder / "mosquitto.conf"
    wanted = [f"listener {port} 127.0.0.1", *(lines or ("allow_anonymous true",)), "persistence false"]
    config.write_text("\n".join(wanted) + "\n")
    return ForeignServer([program, "-c", str(config)], port)


def durable_mosquitto(folder: Path) -> ForeignServer:
    """An MQTT broker that keeps all messages for subscribers who are away, also over a restart."""
    program, port = needed("mosquitto"), free_port()
    place, config = folder / "mosquitto", folder / "mosquitto.conf"
    place.mkdir()
    wanted = [f"listener {port} 127.0.0.1", "allow_anonymous true", "max_queued_messages 0", "max_inflight_messages 0"]
    wanted += ["persistence true", f"persistence_location {place}/", "autosave_on_changes false"]
    if os.geteuid() == 0:
        wanted.append("user root")
    config.write_text("\n".join(wanted) + "\n")
    return ForeignServer([program, "-c", str(config)], port)


def nats_server(folder: Path, *lines: str, jetstream: bool = True) -> ForeignServer:
    """A NATS server with JetStream, whose streams survive a restart; or one without. ``lines`` configure it."""
    program, port = needed("nats-server"), free_port()
    config = folder / "nats.conf"
    config.write_text("\n".join(lines) + "\n")
    streams = ["-js", "-sd", str(folder / "nats")] if jetstream else []
    return ForeignServer([program, "-c", str(config), "-a", "127.0.0.1", "-p", str(port), *streams], port)


def nats_cluster(folder: Path, count: int) -> list[ForeignServer]:
    """The servers of one NATS cluster with JetStream; they have no leader until most of them run."""
    program = needed("nats-server")
    ports = [(free_port(), free_port()) for _ in range(count)]
    routes = ", ".join(f"nats://127.0.0.1:{route}" for _, route in ports)
    servers = []
    for number, (port, route) in enumerate(ports):
        config = folder / f"n{number}.conf"
        config.write_text(
            f'server_name: n{number}\nlisten: "127.0.0.1:{port}"\n'
            f'jetstream {{ store_dir: "{folder / f"n{number}"}" }}\n'
            f'cluster {{ name: test, listen: "127.0.0.1:{route}", routes: [{routes}] }}\n'
        )
        servers.append(ForeignServer([program, "-c", str(config)], port))
    return servers


def influxdb(folder: Path, *lines: str) -> ForeignServer:
    """An InfluxDB 1 that keeps its data in the folder, without users; ``lines`` are of its section ``[http]``."""
    program, port, other = needed("influxd"), free_port(), free_port()
    place, config = folder / "influxdb", folder / "influxdb.conf"
    config.write_text(f"""
reporting-disabled = true
bind-address = "127.0.0.1:{other}"
[meta]
dir = "{place}/meta"
[data]
dir = "{place}/data"
wal-dir = "{place}/wal"
[http]
bind-address = "127.0.0.1:{port}"
{chr(10).join(lines)}
[monitor]
store-enabled = false
""")
    return ForeignServer([program, "run", "-config", str(config)], port)


def victoria_metrics(folder: Path) -> ForeignServer:
    """A VictoriaMetrics, which takes lines of InfluxDB and answers questions of Prometheus."""
    program, port = needed("victoria-metrics"), free_port()
    place = f"-storageDataPath={folder / 'victoria'}"
    options = ["-retentionPeriod=100y", "-search.latencyOffset=1ms", "-memory.allowedPercent=5"]
    return ForeignServer([program, place, f"-httpListenAddr=127.0.0.1:{port}", *options], port)


class PostgresqlServer(ForeignServer):
    """A PostgreSQL server with a database folder of its own and one user, ``collector``, with a password.

    Args:
        syncs: whether it waits for the disk.
        library: one that it loads when it starts, for an extension.
        tls: files with its certificate and its key; without them it offers no TLS.
    """

    PASSWORD = "x9-secret"

    def __init__(self, *, syncs: bool = False, library: str = "", tls: tuple[Path, Path] | None = None) -> None:
        places = [str(path) for path in sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)]
        places[:0] = filter(None, [os.environ.get("BUSWAY_POSTGRESQL")])  # one with extensions that Debian has not
        postgres = Path(needed("initdb", *places)).resolve().with_name("postgres")
        postgres = next((Path(place) / "postgres" for place in places if (Path(place) / "postgres").exists()), postgres)
        initdb = str(postgres.with_name("initdb"))
        self._ready = [str(postgres.with_name("pg_isready")), "-h", "127.0.0.1"]
        user = "postgres" if os.geteuid() == 0 else None
        self.folder = Path(tempfile.mkdtemp(prefix="busway-pg-"))
        if user is not None:
            owner = pwd.getpwnam(user)
            os.chown(self.folder, owner.pw_uid, owner.pw_gid)
        secret = self.folder / "secret"
        secret.write_text(self.PASSWORD)
        if user is not None:
            os.chown(secret, owner.pw_uid, owner.pw_gid)
        data = self.folder / "data"
        command = [initdb, "-D", str(data), "-U", "collector", "-A", "scram-sha-256", "--pwfile", str(secret), "-N"]
        made = subprocess.run(command, user=user, group=user, cwd="/", capture_output=True, timeout=60, check=False)
        assert made.returncode == 0, made.stderr
        port = free_port()
        options = [
            "-c",
            f"fsync={'on' if syncs else 'off'}",
            "-c",
            "listen_addresses=127.0.0.1",
            "-c",
            f"unix_socket_directories={self.folder}",
            "-c",
            f"shared_preload_libraries={library}",
        ]
        if tls is not None:
            options += ["-c", "ssl=on"]
            for key, file in zip(("ssl_cert_file", "ssl_key_file"), tls, strict=True):
                copied = Path(shutil.copy(file, self.folder))
                copied.chmod(0o600)
                if user is not None:
                    os.chown(copied, owner.pw_uid, owner.pw_gid)
                options += ["-c", f"{key}={copied}"]
        super().__init__(
            [str(postgres), "-D", str(data), "-p", str(port), *options], port, user=user, stop=signal.SIGQUIT
        )
        self.url = f"postgresql://collector@127.0.0.1:{port}/postgres"

    def start(self) -> Self:
        """Start the server, and wait until it accepts connections."""
        super().start()
        until = time.monotonic() + READY_SECONDS
        while subprocess.run([*self._ready, "-p", str(self.port)], capture_output=True, check=False).returncode:
            assert time.monotonic() < until, "the database accepts no connection"
            time.sleep(0.05)
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()
        shutil.rmtree(self.folder, ignore_errors=True)

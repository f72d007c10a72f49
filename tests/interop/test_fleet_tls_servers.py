"""Three real nats-servers and an edge site by generated files with TLS: routes, leaf node, and a copied stream."""

import asyncio
import contextlib
import subprocess
from pathlib import Path

import pytest
from foreign_servers import ForeignServer, free_port, needed

from busway.apps.fleet.coordinator import CoordinatorDown
from busway.apps.fleet.coordinators.nats import NatsCoordinator, connect_nats, find_bucket
from busway.apps.fleet.coordinators.opening import CoordinatorOptions, open_coordinator
from busway.apps.fleet.streams import StreamOptions, make_stream
from busway.cli.fleet_servers import write_server_files

pytest.importorskip("nats")
pytest.importorskip("nkeys")
pytestmark = pytest.mark.real_time


def certificates(folder: Path, names: tuple[str, ...]) -> None:
    """Make an authority, and for each server a certificate that is good for servers and for clients."""
    openssl = needed("openssl")

    def run(*words: str) -> None:
        subprocess.run([openssl, *words], cwd=folder, check=True, capture_output=True)

    curve = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")
    authority = ("-addext", "basicConstraints=critical,CA:TRUE", "-addext", "keyUsage=critical,keyCertSign,cRLSign")
    run("req", "-x509", *curve, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=plant", "-days", "30", *authority)
    (folder / "purposes").write_text("subjectAltName = IP:127.0.0.1\nextendedKeyUsage = serverAuth, clientAuth\n")
    for name in names:
        run("req", *curve, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        signed = ("-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-days", "30", "-extfile", "purposes")
        run("x509", "-req", "-in", f"{name}.csr", "-out", f"{name}.pem", *signed)


async def test_a_cluster_and_an_edge_site_work_by_generated_files_with_tls(tmp_path: Path) -> None:
    ports = [free_port() for _ in range(3)]
    edge_port = free_port()
    certificates(tmp_path, ("n1", "n2", "n3", "yard"))
    write_server_files(
        "hall", str(tmp_path), ",".join(f"127.0.0.1:{port}" for port in ports), "2.9", str(tmp_path / "js"),
        str(tmp_path), force=False, sites=f"yard=127.0.0.1:{edge_port}",
    )  # fmt: skip
    program = needed("nats-server")

    async def opened(
        stack: contextlib.AsyncExitStack, port: int, zone: str, role: str, replicas: int, domain: str | None = None
    ) -> NatsCoordinator:
        options = CoordinatorOptions(
            credentials=str(tmp_path / f"{zone}-{role}.nk"),
            ca=str(tmp_path / "ca.pem"),
            domain=domain,
            replicas=replicas,
        )
        table = await open_coordinator(f"tls://127.0.0.1:{port}", zone, options)
        stack.push_async_callback(table.close)
        assert isinstance(table, NatsCoordinator)
        return table

    async with contextlib.AsyncExitStack() as stack:

        def started(name: str, port: int) -> ForeignServer:
            return stack.enter_context(ForeignServer([program, "-c", str(tmp_path / f"{name}.conf")], port))

        first, *_ = [started(name, port) for name, port in zip(("n1", "n2", "n3"), ports, strict=True)]
        operator = await opened(stack, ports[0], "hall", "operator", 3)
        made = await operator.create("control.configuration", b"a plant")
        first.stop()  # of three one may be lost: the others have the entry
        other = await opened(stack, ports[1], "hall", "operator", 3)
        assert await other.replace("control.configuration", b"another plant", made) > made

        key = CoordinatorOptions(
            credentials=str(tmp_path / "yard-operator.nk"), ca=str(tmp_path / "ca.pem"), domain="yard"
        )
        early = await connect_nats(f"tls://127.0.0.1:{ports[1]}", key)
        stack.push_async_callback(early.close)
        with pytest.raises(CoordinatorDown, match="no server of site yard answers through the centre"):
            await find_bucket(early, "busway-yard", key)
        started("yard", edge_port)
        far = await opened(stack, ports[1], "yard", "operator", 1, "yard")
        await far.create("control.configuration", b"from the centre")
        await make_stream(far.client, "yard", StreamOptions(source="yard"), start=60.0)
        collector = await opened(stack, edge_port, "yard", "collector", 1)
        await collector.client.jetstream(timeout=10).publish("busway.yard.samples.0001", b"over the leaf node")
        async with asyncio.timeout(60):
            while await messages_of(far, "busway-samples-yard") != 1:  # noqa: ASYNC110 - the server tells nothing
                await asyncio.sleep(0.1)
        for offset in (0, 2000, 3200):  # clients, routes and sites: nothing of it is read without TLS
            await refuses_plain_text(ports[1] + offset)


async def messages_of(table: NatsCoordinator, stream: str) -> int:
    return int((await table.client.jetstream(timeout=10).stream_info(stream)).state.messages)


async def refuses_plain_text(port: int) -> None:
    """The server answers nothing but what it is to a program that does not speak TLS, and ends the connection."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(b"CONNECT {}\r\nPING\r\n")
    async with asyncio.timeout(30):
        answer = await reader.read()
    assert b"PONG" not in answer
    writer.close()

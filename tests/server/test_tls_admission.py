"""TLS handshakes of a listener: which clients are accepted, which are refused and why, and what is left of those."""

import asyncio
import contextlib
import logging
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from handles import open_handles
from tls_peers import OF_SSL, READ, VERSIONS, ask, foreign_client, foreign_context, one_version, query, receive_adu
from waiting import until

import busway
from busway.errors import ConfigError
from busway.options.tls import TlsParameters, TlsVersion
from busway.server.listener import Listener
from busway.server.serving import ServerThread
from busway.server.status import SecurityStatus
from busway.testing.certificates import CertificateFiles, CertificateStore

pytestmark = pytest.mark.usefixtures("transport")

REGISTER = 1234
REPLY = bytes.fromhex("0001 0000 0005 01 03 02 04D2")
LONGEST_WAIT = 10.0

Store = CertificateStore


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return Store(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def server_files(store: Store) -> CertificateFiles:
    return store.server()


@pytest.fixture(scope="module")
def operator(store: Store) -> CertificateFiles:
    return store.client("operator", role="Operator")


@pytest.fixture
def served(server_files: CertificateFiles) -> Iterator[ServerThread]:
    with busway.serve_in_thread(f"tls://127.0.0.1:0?{server_files.query()}", units=device()) as server:
        yield server


def device() -> busway.Device:
    return busway.Device(holding_registers=[REGISTER, 1, 2])


def port_of(server: ServerThread | busway.Server) -> int:
    return int(server.endpoints[0].rpartition(":")[2])


def security_of(server: ServerThread | busway.Server) -> SecurityStatus:
    found = server.status().listeners[0].security
    assert found is not None
    return found


def wait_for(condition: Callable[[], bool]) -> None:
    """Until what happens in the server's thread has happened."""
    limit = time.monotonic() + LONGEST_WAIT
    while not condition():
        assert time.monotonic() < limit


# --- who comes in -----------------------------------------------------------------------------------------------------


@pytest.mark.clause("M1")
@pytest.mark.parametrize("version", VERSIONS)
def test_a_client_with_a_certificate_is_answered(
    served: ServerThread, operator: CertificateFiles, version: TlsVersion
) -> None:
    with foreign_client(port_of(served), foreign_context(operator, operator, version)) as client:
        assert ask(client) == REPLY
        assert client.version() == f"TLSv{version.value}"
        (connection,) = served.status().connections
    assert connection.role == "Operator"
    assert connection.subject == "CN=operator"
    security = security_of(served)
    assert security.established == 1
    assert security.refused == {}


@pytest.mark.clause("M1")
@pytest.mark.parametrize("sizes", [(1,), (7,), (3, 9), (5, 1, 20), (1000,)], ids=str)
def test_requests_may_be_cut_into_records_anywhere(
    served: ServerThread, operator: CertificateFiles, sizes: tuple[int, ...]
) -> None:
    requests = b"".join(number.to_bytes(2, "big") + READ[2:] for number in range(5))
    with foreign_client(port_of(served), foreign_context(operator, operator)) as client:
        at = turn = 0
        while at < len(requests):
            size = sizes[turn % len(sizes)]
            client.sendall(requests[at : at + size])  # one record each
            at, turn = at + size, turn + 1
        for number in range(5):
            assert receive_adu(client) == number.to_bytes(2, "big") + REPLY[2:]


@pytest.mark.clause("M1")
def test_records_may_be_cut_into_segments_anywhere(served: ServerThread, operator: CertificateFiles) -> None:
    """The bytes of TLS reach the server one by one, handshake and all."""
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    tls = foreign_context(operator, operator).wrap_bio(incoming, outgoing, server_hostname="localhost")
    with socket.create_connection(("127.0.0.1", port_of(served)), LONGEST_WAIT) as below:
        below.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)

        def run(step: Callable[[], object]) -> object:
            while True:
                try:
                    result, wants = step(), False
                except ssl.SSLWantReadError:
                    result, wants = None, True
                for byte in outgoing.read():
                    below.sendall(bytes([byte]))
                if not wants:
                    return result
                incoming.write(below.recv(1))

        run(tls.do_handshake)
        run(lambda: tls.write(READ))
        assert run(lambda: tls.read(len(REPLY))) == REPLY


@pytest.mark.clause("M1")
def test_many_requests_in_flight_over_large_records_are_all_answered(
    served: ServerThread, operator: CertificateFiles
) -> None:
    url = f"{served.endpoints[0]}?{operator.query()}"
    with busway.connect(url, max_transactions=16) as link:
        unit = link.unit(1)
        for _ in range(50):
            assert unit.read_holding_registers(0, count=3) == [REGISTER, 1, 2]


@pytest.mark.clause("T39")
def test_a_client_that_is_held_back_by_its_rate_gets_every_reply(
    server_files: CertificateFiles, operator: CertificateFiles
) -> None:
    """What has been decrypted waits inside while nothing is read; it is answered later, and in order."""
    requests = [number.to_bytes(2, "big") + READ[2:] for number in range(400)]
    url = f"tls://127.0.0.1:0?{server_files.query()}"
    with (
        busway.serve_in_thread(url, units=device(), request_rate=300.0) as server,
        foreign_client(port_of(server), foreign_context(operator, operator)) as client,
    ):
        client.sendall(b"".join(requests))  # one record
        replies = [receive_adu(client) for _ in requests]
    assert replies == [request[:2] + REPLY[2:] for request in requests]


@pytest.mark.clause("M1")
def test_the_usual_port_is_802() -> None:
    assert busway.parse_endpoint("tls://plc-7").port == 802


# --- who does not -----------------------------------------------------------------------------------------------------

Maker = Callable[[Store], CertificateFiles | None]

REFUSED_CLIENTS: dict[str, tuple[Maker, str, str]] = {
    "none": (lambda store: None, "no certificate", "the client sent no certificate"),
    "expired": (
        lambda store: store.expired_client(role="Operator"),
        "expired",
        "the client's certificate has expired (one of its chain; or the clock here is wrong)",
    ),
    "self-signed": (
        lambda store: store.self_signed(),
        "self-signed",
        "the client's certificate is signed by itself, and not by an authority that is known here",
    ),
    "foreign": (
        lambda store: store.client("stranger", role="Operator", authority=store.foreign),
        "unknown authority",
        "the client's certificate is signed by an authority that is not known here",
    ),
    "a server's": (
        lambda store: store.server("posing"),
        "wrong purpose",
        "the client's certificate is not meant for this purpose (extended key usage)",
    ),
    "two roles": (
        lambda store: store.client_with_two_roles(b"\x0c\x08Operator", b"\x0c\x05Admin"),
        "two roles",
        "the client's certificate has two roles",
    ),
    "twice the same role": (
        lambda store: store.client_with_two_roles(b"\x0c\x08Operator", b"\x0c\x08Operator", name="twice"),
        "two roles",
        "the client's certificate has two roles",
    ),
}

ROLELESS_CLIENTS: dict[str, tuple[Maker, str]] = {
    "no role": (lambda store: store.client("no role"), "CN=no role has no role, and one is required"),
    "printable string": (
        lambda store: store.client_with_role_value(b"\x13\x08Operator"),
        "CN=odd role has no role (its ASN.1 type is 0x13, and not UTF8String), and one is required",
    ),
    "trailing byte": (
        lambda store: store.client_with_role_value(b"\x0c\x08Operator\x00"),
        "CN=odd role has no role (its length says 8 bytes, and there are 9), and one is required",
    ),
    "empty": (
        lambda store: store.client_with_role_value(b"\x0c\x00"),
        "CN=odd role has no role (the text is empty), and one is required",
    ),
    "no UTF-8": (
        lambda store: store.client_with_role_value(b"\x0c\x02\xc3\x28"),
        "CN=odd role has no role (the text is no UTF-8), and one is required",
    ),
}


def try_to_read(port: int, context: ssl.SSLContext) -> str:
    """What a client hears of its refusal; with TLS 1.3 it may hear it as late as with its first read."""
    try:
        with foreign_client(port, context) as client:
            return ask(client).hex() or "closed"
    except ssl.SSLError as error:
        return error.reason or str(error)
    except ConnectionError as error:
        return type(error).__name__


@pytest.mark.clause("M3")
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("case", REFUSED_CLIENTS)
def test_a_bad_certificate_is_refused_by_its_reason(
    store: Store,
    served: ServerThread,
    operator: CertificateFiles,
    caplog: pytest.LogCaptureFixture,
    case: str,
    version: TlsVersion,
) -> None:
    make, kind, sentence = REFUSED_CLIENTS[case]
    context = foreign_context(operator, make(store), version)
    handles = open_handles()
    heard = try_to_read(port_of(served), context)
    wait_for(lambda: security_of(served).refused == {kind: 1})
    wait_for(lambda: open_handles() == handles)
    assert f"refused at {served.endpoints[0]}: {sentence}" in caplog.text
    assert security_of(served).handshakes == 0
    assert served.status().counters.accepted == 0
    assert served.status().counters.requests == 0
    # OpenSSL sends the alert of what it finds; what we find ourselves ends with the connection.
    assert heard == "closed" if case in ("two roles", "twice the same role") else "ALERT" in heard


@pytest.mark.clause("M5")
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("case", ROLELESS_CLIENTS)
def test_without_a_role_a_client_is_refused_where_one_is_required(
    store: Store,
    server_files: CertificateFiles,
    caplog: pytest.LogCaptureFixture,
    case: str,
    version: TlsVersion,
) -> None:
    make, sentence = ROLELESS_CLIENTS[case]
    files = make(store)
    assert files is not None
    with busway.serve_in_thread("tcp://127.0.0.1:0", units=device()):
        pass  # the first event loop of a process keeps a pipe for good
    handles = open_handles()
    tls = TlsParameters(**server_files.options(), require_role=True)
    with busway.serve_in_thread("tls://127.0.0.1:0", units=device(), tls=tls) as server:
        heard = try_to_read(port_of(server), foreign_context(files, files, version))
        wait_for(lambda: security_of(server).refused == {"no role": 1})
        assert server.status().counters.requests == 0
    assert heard == "closed"
    assert sentence in caplog.text
    assert open_handles() == handles


@pytest.mark.clause("M5")
@pytest.mark.parametrize("case", ROLELESS_CLIENTS)
def test_without_a_role_a_client_has_none_where_none_is_required(
    store: Store, served: ServerThread, caplog: pytest.LogCaptureFixture, case: str
) -> None:
    make, _ = ROLELESS_CLIENTS[case]
    files = make(store)
    assert files is not None
    with foreign_client(port_of(served), foreign_context(files, files)) as client:
        assert ask(client) == REPLY
        (connection,) = served.status().connections
    assert connection.role is None
    assert security_of(served).without_role == 1
    assert ("has no role: " in caplog.text) == (case != "no role")


@pytest.mark.clause("M2")
def test_tls_1_1_is_refused(served: ServerThread, operator: CertificateFiles) -> None:
    hello = bytes.fromhex(  # a ClientHello of TLS 1.1 with one suite, from RFC 4346 §7.4.1.2
        "16 0301 002d 01 000029 0302" + "00" * 32 + "00 0002 c013 01 00"
    )
    with socket.create_connection(("127.0.0.1", port_of(served)), LONGEST_WAIT) as client:
        client.sendall(hello)
        answer = client.recv(100)
    assert answer[:1] == b"\x15"  # an alert
    assert answer[5:7] == b"\x02\x46"  # fatal, protocol_version
    wait_for(lambda: security_of(served).refused == {"wrong version": 1})


@pytest.mark.clause("M2")
@pytest.mark.parametrize(
    "suite", ["ECDHE-ECDSA-AES128-SHA", "ECDHE-ECDSA-AES128-SHA256", "ECDHE-ECDSA-CHACHA20-POLY1305"]
)
def test_a_suite_that_is_not_allowed_is_refused(served: ServerThread, operator: CertificateFiles, suite: str) -> None:
    context = foreign_context(operator, operator, TlsVersion.TLS_1_2)
    context.set_ciphers(f"{suite}:@SECLEVEL=0")
    assert "HANDSHAKE_FAILURE" in try_to_read(port_of(served), context)
    wait_for(lambda: security_of(served).refused == {"no common suite": 1})


@pytest.mark.clause("M2")
@pytest.mark.parametrize("suite", ["ECDHE-ECDSA-AES128-GCM-SHA256", "ECDHE-ECDSA-AES256-GCM-SHA384"])
def test_suites_with_gcm_over_p_256_are_agreed_on_without_compression(
    served: ServerThread, operator: CertificateFiles, suite: str
) -> None:
    context = foreign_context(operator, operator, TlsVersion.TLS_1_2)
    context.set_ciphers(suite)
    context.set_ecdh_curve("prime256v1")
    with foreign_client(port_of(served), context) as client:
        assert ask(client) == REPLY
        assert client.cipher()[0] == suite  # type: ignore[index]
        assert client.compression() is None


@pytest.mark.clause("M2")
def test_an_rsa_certificate_is_served_with_ecdhe_rsa(store: Store, operator: CertificateFiles, tmp_path: Path) -> None:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import rsa

    key = rsa.generate_private_key(65537, 2048)
    model = store.server("rsa").issued.certificate
    builder = (
        x509.CertificateBuilder(model.issuer, model.subject, key.public_key(), x509.random_serial_number())
        .not_valid_before(model.not_valid_before_utc)
        .not_valid_after(model.not_valid_after_utc)
    )
    for one in model.extensions:
        if not isinstance(one.value, x509.SubjectKeyIdentifier):
            builder = builder.add_extension(one.value, one.critical)
    certificate = builder.sign(store.authority.issued.key, hashes.SHA256())
    (tmp_path / "rsa.pem").write_bytes(
        certificate.public_bytes(serialization.Encoding.PEM)
        + key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    tls = TlsParameters(certificate=str(tmp_path / "rsa.pem"), authority=str(store.authority_file))
    with busway.serve_in_thread("tls://127.0.0.1:0", units=device(), tls=tls) as server:
        context = foreign_context(operator, operator, TlsVersion.TLS_1_2)
        with foreign_client(port_of(server), context) as client:
            assert ask(client) == REPLY
            assert client.cipher()[0] == "ECDHE-RSA-AES128-GCM-SHA256"  # type: ignore[index]


@pytest.mark.clause("M1")
def test_what_is_no_tls_is_refused_and_never_reaches_the_device(served: ServerThread) -> None:
    handles = open_handles()
    with socket.create_connection(("127.0.0.1", port_of(served)), LONGEST_WAIT) as client:
        client.sendall(READ)
        wait_for(lambda: security_of(served).refused == {"not TLS": 1})
    wait_for(lambda: open_handles() == handles)
    assert served.status().counters.requests == 0


@pytest.mark.clause("T35")
@pytest.mark.clause("M3")
@pytest.mark.parametrize("version", VERSIONS)
def test_a_revoked_client_is_refused_as_soon_as_the_list_is_read_again(
    store: Store, server_files: CertificateFiles, caplog: pytest.LogCaptureFixture, version: TlsVersion
) -> None:
    files = store.client("soon lost")
    context = foreign_context(files, files, version)
    revocations = store.revocation_list(name="read again")
    url = f"tls://127.0.0.1:0?{server_files.query()}&revocation_list={revocations}"
    with busway.serve_in_thread(url, units=device()) as server:
        with foreign_client(port_of(server), context) as client:
            assert ask(client) == REPLY
        store.revocation_list(files, name="read again")
        server.reload_security()
        assert "ALERT" in try_to_read(port_of(server), context)
        wait_for(lambda: security_of(server).refused == {"revoked": 1})
        assert "the client's certificate is revoked" in caplog.text
        revocations.write_bytes(b"damaged")
        with pytest.raises(ConfigError, match="there is no revocation list in it"):
            server.reload_security()
        assert "ALERT" in try_to_read(port_of(server), context)  # the list before still holds


@pytest.mark.clause("M3")
def test_with_a_list_that_has_expired_no_client_is_let_in_and_the_log_says_what_is_needed(
    store: Store, server_files: CertificateFiles, operator: CertificateFiles, caplog: pytest.LogCaptureFixture
) -> None:
    revocations = store.revocation_list(name="expired", days=-1.0)
    url = f"tls://127.0.0.1:0?{server_files.query()}&revocation_list={revocations}"
    with busway.serve_in_thread(url, units=device()) as server:
        assert "ALERT" in try_to_read(port_of(server), foreign_context(operator, operator))
        wait_for(lambda: security_of(server).refused == {"not known whether revoked": 1})
    assert "a revocation list has expired, and a new one is needed" in caplog.text


@pytest.mark.clause("M3")
def test_a_client_refuses_a_revoked_server_and_says_why(store: Store, operator: CertificateFiles) -> None:
    lost = store.server("lost server")
    with busway.serve_in_thread(f"tls://127.0.0.1:0?{lost.query()}", units=device()) as server:
        for revocations, sentence in (
            (store.revocation_list(lost, name="of servers"), "the server's certificate is revoked"),
            (store.revocation_list(name="old", days=-1.0), "a revocation list has expired"),
        ):
            url = f"{server.endpoints[0]}?{operator.query()}&revocation_list={revocations}"
            with pytest.raises(busway.LinkDown, match=sentence), busway.connect(url, shared=False, retries=0) as link:
                link.unit(1).read_holding_registers(0, count=1)
        revocations = store.revocation_list(name="of servers")
        url = f"{server.endpoints[0]}?{operator.query()}&revocation_list={revocations}"
        with busway.connect(url, shared=False) as link:
            assert link.unit(1).read_holding_registers(0, count=1) == [REGISTER]


@pytest.mark.clause("M3")
@pytest.mark.parametrize("strict", [False, True], ids=["standard", "strict"])
def test_a_certificate_that_does_not_say_what_it_is_for_is_refused_by_the_preset_strict(
    store: Store, server_files: CertificateFiles, operator: CertificateFiles, strict: bool
) -> None:
    options = {"preset": "strict", "standard_port": False} if strict else {}
    files = store.client_without_purpose()
    with busway.serve_in_thread(f"tls://127.0.0.1:0?{server_files.query()}", units=device(), **options) as server:
        heard = try_to_read(port_of(server), foreign_context(files, files))
        assert heard == ("closed" if strict else REPLY.hex())
        if strict:
            wait_for(lambda: security_of(server).refused == {"wrong purpose": 1})
        assert try_to_read(port_of(server), foreign_context(operator, operator)) == REPLY.hex()


def test_an_option_that_contradicts_the_preset_is_refused(server_files: CertificateFiles) -> None:
    url = f"tls://127.0.0.1:0?{server_files.query()}&require_purpose=off"
    with pytest.raises(ConfigError, match="require_purpose: does not go with the preset strict"):
        busway.serve(url, units=device(), preset="strict", standard_port=False)


def test_an_address_that_is_refused_never_gets_to_a_handshake(server_files: CertificateFiles) -> None:
    with busway.serve_in_thread(
        f"tls://127.0.0.1:0?{server_files.query()}", units=device(), authorize=lambda host: False
    ) as server:
        client = socket.create_connection(("127.0.0.1", port_of(server)), LONGEST_WAIT)
        with client, contextlib.suppress(ConnectionResetError):
            assert client.recv(1) == b""
        wait_for(lambda: server.status().counters.unauthorized == 1)
        security = security_of(server)
    assert (security.handshakes, security.established, security.refused) == (0, 0, {})


async def test_a_handshake_that_new_address_lists_end_counts_as_one_that_was_let_in(
    server_files: CertificateFiles, caplog: pytest.LogCaptureFixture
) -> None:
    denied = set[str]()
    async with busway.serve(
        f"tls://127.0.0.1:0?{server_files.query()}", units=device(), authorize=lambda host: host not in denied
    ) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", port_of(server))
        await until(lambda: security_of(server).handshakes == 1)
        assert server.end_unauthorized() == 0
        denied.add("127.0.0.1")
        assert server.end_unauthorized() == 1
        with contextlib.suppress(ConnectionResetError):
            assert await reader.read() == b""
        writer.close()
        await until(lambda: security_of(server).handshakes == 0)
        counters = server.status().counters
    assert (counters.unauthorized, counters.no_longer_authorized) == (0, 1)
    assert "ended: it is no longer authorized" in caplog.text
    assert "before anything was read" not in caplog.text


# --- limits -----------------------------------------------------------------------------------------------------------


@pytest.mark.clause("M3")
async def test_a_handshake_that_takes_too_long_is_ended(server_files: CertificateFiles) -> None:
    url = f"tls://127.0.0.1:0?{server_files.query()}&handshake_timeout=0.1"
    async with busway.serve(url, units=device()) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", port_of(server))
        writer.write(b"\x16\x03\x01")  # the beginning of a record, and never more
        assert await reader.read() == b""
        writer.close()
        await writer.wait_closed()
        assert security_of(server).refused == {"too slow": 1}
        assert security_of(server).handshakes == 0


async def test_beyond_the_limit_the_oldest_handshake_makes_room(
    server_files: CertificateFiles, operator: CertificateFiles
) -> None:
    url = f"tls://127.0.0.1:0?{server_files.query()}&max_handshakes=2"
    async with busway.serve(url, units=device()) as server:
        silent = []
        for number in range(2):
            silent.append(await asyncio.open_connection("127.0.0.1", port_of(server)))
            await until(lambda number=number: security_of(server).handshakes == number + 1)  # type: ignore[misc]
        async with busway.open(f"{server.endpoints[0]}?{operator.query()}") as link:
            assert await link.unit(1).read_holding_registers(0, count=1) == [REGISTER]
        assert await silent[0][0].read() == b""
        assert security_of(server).refused == {"crowded out": 1}
        assert security_of(server).handshakes == 1
        for _, writer in silent:
            writer.close()
            await writer.wait_closed()


@pytest.mark.clause("T39")
def test_over_tls_too_nothing_is_read_from_a_client_that_takes_no_replies(
    server_files: CertificateFiles, operator: CertificateFiles
) -> None:
    url = f"tls://127.0.0.1:0?{server_files.query()}"
    limits = {"write_buffer": 16_384, "send_buffer": 16_384, "receive_buffer": 16_384, "write_timeout": 0.5}
    with (
        busway.serve_in_thread(url, units=busway.Device(holding_registers=125), **limits) as server,
        foreign_client(port_of(server), foreign_context(operator, operator)) as client,
    ):
        client.settimeout(0.2)
        questions = 100 * bytes.fromhex("0001 0000 0006 01 03 0000 007D")
        with contextlib.suppress(OSError):  # it takes no more, or has closed
            while True:
                client.sendall(questions)
        wait_for(lambda: server.status().counters.write_timeouts == 1)
        counters = server.status().counters
        assert counters.reading_paused >= 1  # it may take a little now and then, while its own buffer grows
        assert counters.other.sent < 16 << 20


@pytest.mark.clause("M1")
def test_thousands_of_requests_in_a_few_records_are_answered_in_order_and_their_end_is_heard_behind_them(
    served: ServerThread, operator: CertificateFiles
) -> None:
    count = 3000
    questions = b"".join(one.to_bytes(2, "big") + READ[2:-2] + b"\0\0" for one in range(count))  # refused, with 03
    with foreign_client(port_of(served), foreign_context(operator, operator)) as client:
        client.sendall(questions)  # the buffers of the system hold them: one thread, as OpenSSL wants it
        answers = b""
        while len(answers) < 9 * count:
            answers += client.recv(65_536)
        assert [int.from_bytes(answers[at : at + 2], "big") for at in range(0, 9 * count, 9)] == list(range(count))
        client.sendall(questions[:1200])
        with contextlib.suppress(ssl.SSLError):  # it tells the end, and is told by answers that there is more
            client.unwrap()
        with socket.socket(fileno=client.detach()) as below:
            below.settimeout(LONGEST_WAIT)
            while below.recv(65_536):
                pass
    wait_for(lambda: not served.status().connections)
    assert served.status().counters.requests == count + 100


@pytest.mark.clause("T13")
async def test_strangers_take_no_priority_host_its_handshake(
    server_files: CertificateFiles, operator: CertificateFiles
) -> None:
    url = f"tls://127.0.0.1:0?{server_files.query()}&max_handshakes=2"
    async with busway.serve(url, units=device(), priority=["127.0.0.2"]) as server:
        new_connections = []

        async def come(host: str, handshakes: int) -> asyncio.StreamReader:
            reader, writer = await asyncio.open_connection("127.0.0.1", port_of(server), local_addr=(host, 0))
            new_connections.append(writer)
            await until(lambda: security_of(server).handshakes == handshakes)
            return reader

        priority = [await come("127.0.0.2", 1)]
        strangers = [await come("127.0.0.3", 2), await come("127.0.0.4", 2)]
        assert await strangers[0].read() == b""  # the second took its place, and not that of the priority host
        priority.append(await come("127.0.0.2", 2))
        assert await strangers[1].read() == b""
        with contextlib.suppress(ConnectionResetError):
            assert await (await come("127.0.0.3", 2)).read() == b""  # no connection is left to make room for it
        assert security_of(server).refused == {"crowded out": 3}
        own = f"{server.endpoints[0]}?{operator.query()}"
        async with busway.open(own, local_address="127.0.0.2") as link:  # the oldest of its own makes room
            assert await link.unit(1).read_holding_registers(0, count=1) == [REGISTER]
        assert await priority[0].read() == b""
        assert security_of(server).handshakes == 1
        for writer in new_connections:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()


async def test_clients_that_all_come_back_at_once_are_all_let_in(
    server_files: CertificateFiles, operator: CertificateFiles
) -> None:
    async with busway.serve(f"tls://127.0.0.1:0?{server_files.query()}", units=device()) as server:
        url = f"{server.endpoints[0]}?{operator.query()}"

        async def come() -> list[int]:
            async with busway.open(url, shared=False, max_connections=60) as link:
                return await link.unit(1).read_holding_registers(0, count=1)

        assert await asyncio.gather(*(come() for _ in range(60))) == [[REGISTER]] * 60
        assert security_of(server).established == 60


@pytest.mark.real_time
async def test_a_server_stops_at_once_while_handshakes_are_under_way(server_files: CertificateFiles) -> None:
    handles = open_handles()
    async with busway.serve(f"tls://127.0.0.1:0?{server_files.query()}", units=device()) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", port_of(server))
        await until(lambda: security_of(server).handshakes == 1)
        begun = time.monotonic()
    assert time.monotonic() - begun < 1.0
    with contextlib.suppress(ConnectionResetError):
        assert await reader.read() == b""
    writer.close()
    await until(lambda: open_handles() == handles)


def test_two_hundred_refusals_leave_no_handle_behind(
    served: ServerThread, store: Store, operator: CertificateFiles, caplog: pytest.LogCaptureFixture
) -> None:
    stranger = store.client("stranger", authority=store.foreign)
    context = foreign_context(operator, stranger)
    handles = open_handles()
    for _ in range(200):
        try_to_read(port_of(served), context)
    wait_for(lambda: security_of(served).refused == {"unknown authority": 200})
    assert caplog.text.count("refused at") == 1  # in a minute
    wait_for(lambda: open_handles() == handles)
    assert security_of(served).handshakes == 0


# --- sessions ---------------------------------------------------------------------------------------------------------


@pytest.mark.clause("M4")
@pytest.mark.clause("M5")
@pytest.mark.parametrize("version", VERSIONS)
def test_a_resumed_session_keeps_certificate_and_role(
    served: ServerThread, operator: CertificateFiles, version: TlsVersion
) -> None:
    context = foreign_context(operator, operator, version)
    with foreign_client(port_of(served), context) as client:
        assert ask(client) == REPLY
        session = client.session
        client.unwrap()
    with foreign_client(port_of(served), context, session) as client:
        assert ask(client) == REPLY
        assert client.session_reused
        wait_for(lambda: len(served.status().connections) == 1)
        (connection,) = served.status().connections
    assert connection.role == "Operator"
    assert connection.subject == "CN=operator"
    assert security_of(served).resumed == 1


@pytest.mark.clause("M4")
@pytest.mark.parametrize("version", VERSIONS)
def test_after_a_fatal_alert_a_session_is_not_resumed(
    served: ServerThread, operator: CertificateFiles, version: TlsVersion
) -> None:
    context = foreign_context(operator, operator, version)
    with foreign_client(port_of(served), context) as client:
        assert ask(client) == REPLY
        session = client.session
        below = socket.socket(fileno=client.detach())
        with below:
            below.sendall(bytes.fromhex("17 0303 0020") + bytes(32))  # a record that was not encrypted
            below.settimeout(LONGEST_WAIT)
            with contextlib.suppress(ConnectionResetError):
                while below.recv(100):
                    pass
    wait_for(lambda: not served.status().connections)
    with foreign_client(port_of(served), context, session) as client:
        assert ask(client) == REPLY
        assert not client.session_reused


@pytest.mark.clause("M4")
@pytest.mark.parametrize("version", VERSIONS)
def test_a_session_ends_with_the_certificate_it_was_made_with(
    served: ServerThread,
    operator: CertificateFiles,
    version: TlsVersion,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    context = foreign_context(operator, operator, version)
    with foreign_client(port_of(served), context) as client:
        assert ask(client) == REPLY
        session = client.session
        client.unwrap()
    later = time.time() + 31 * 86_400
    monkeypatch.setattr("busway.server.tls_admission.now", lambda: later)
    with foreign_client(port_of(served), context, session) as client:
        assert client.session_reused
        assert ask(client) == b""
    assert security_of(served).refused == {"expired": 1}


# --- certificates -----------------------------------------------------------------------------------------------------


@pytest.mark.clause("M3")
def test_the_chain_up_to_the_root_is_sent(store: Store, operator: CertificateFiles) -> None:
    plant = store.authority.intermediate("plant authority")
    files = store.server("below", authority=plant)
    with (
        busway.serve_in_thread(f"tls://127.0.0.1:0?{files.query()}", units=device()) as server,
        foreign_client(port_of(server), foreign_context(operator, operator)) as client,
    ):
        assert ask(client) == REPLY  # the client knows the root alone


@pytest.mark.clause("M3")
def test_a_client_below_an_intermediate_authority_comes_in(store: Store, served: ServerThread) -> None:
    plant = store.authority.intermediate("plant authority")
    files = store.client("below", role="Viewer", authority=plant)
    with foreign_client(port_of(served), foreign_context(files, files)) as client:
        assert ask(client) == REPLY


def test_new_certificates_hold_from_the_next_connection_on(
    store: Store, operator: CertificateFiles, tmp_path: Path
) -> None:
    own = Store(tmp_path)
    files = own.server("first", authority=store.authority)
    own.authority_file.write_bytes(store.authority_file.read_bytes())
    context = foreign_context(operator, operator)
    with busway.serve_in_thread(f"tls://127.0.0.1:0?{files.query()}", units=device()) as server:
        with foreign_client(port_of(server), context) as before:
            assert ask(before) == REPLY
            store.authority.server(["localhost"], name="second").write(files.certificate, files.key)
            server.reload_security()
            assert ask(before) == REPLY
            with foreign_client(port_of(server), context) as after:
                assert ask(after) == REPLY
                assert after.getpeercert()["subject"] == ((("commonName", "second"),),)  # type: ignore[index]
        assert security_of(server).subject == "CN=second"
        assert security_of(server).reloads == 1
        own.authority_file.write_bytes(store.foreign.issued.certificate_pem())
        server.reload_security()
        assert "UNKNOWN_CA" in try_to_read(port_of(server), context)


def test_files_that_cannot_be_used_change_nothing(store: Store, operator: CertificateFiles, tmp_path: Path) -> None:
    own = Store(tmp_path)
    files = own.server("first", authority=store.authority)
    own.authority_file.write_bytes(store.authority_file.read_bytes())
    with busway.serve_in_thread(f"tls://127.0.0.1:0?{files.query()}", units=device()) as server:
        files.certificate.write_text("nothing")
        with pytest.raises(ConfigError, match=r"first\.pem: certificate: there is no certificate in it"):
            server.reload_security()
        with foreign_client(port_of(server), foreign_context(operator, operator)) as client:
            assert ask(client) == REPLY
        assert security_of(server).subject == "CN=first"


def test_the_status_shows_when_the_certificate_expires(served: ServerThread) -> None:
    security = security_of(served)
    assert security.subject == "CN=server"
    assert security.not_after == pytest.approx(time.time() + 30.5 * 86_400, abs=3600)
    assert 30 < security.days_left < 31


@pytest.mark.parametrize(
    ("days", "sentence"), [(29.9, "expires on"), (-1.0, "has expired on"), (31.0, None)], ids=["soon", "past", "later"]
)
def test_a_certificate_that_expires_soon_is_said_at_the_start(
    store: Store, caplog: pytest.LogCaptureFixture, days: float, sentence: str | None
) -> None:
    files = store.server("ageing", days=days)
    with (
        caplog.at_level(logging.WARNING, "busway"),
        busway.serve_in_thread(f"tls://127.0.0.1:0?{files.query()}", units=device()),
    ):
        pass
    assert (f"the certificate CN=ageing {sentence}" in caplog.text) == (sentence is not None)


@pytest.mark.parametrize(
    ("missing", "sentence"),
    [
        ("certificate", "a tls:// listener needs a certificate"),
        ("authority", "a tls:// listener needs the authority that its clients come from"),
    ],
)
def test_a_listener_without_its_files_is_refused(server_files: CertificateFiles, missing: str, sentence: str) -> None:
    options = {name: value for name, value in server_files.options().items() if name != missing}
    if missing == "certificate":
        del options["key"]
    with pytest.raises(ConfigError, match=sentence):
        busway.serve(f"tls://127.0.0.1:0?{query(options)}", units=device())


def test_options_of_clients_mean_nothing_to_a_listener(server_files: CertificateFiles) -> None:
    with pytest.raises(ConfigError, match="verify: unknown option of a listener"):
        busway.serve(f"tls://127.0.0.1:0?{server_files.query()}&verify=always", units=device())


def test_a_url_goes_before_the_parameters_of_a_listener(
    server_files: CertificateFiles, operator: CertificateFiles
) -> None:
    tls = TlsParameters(**server_files.options(), **one_version(TlsVersion.TLS_1_2))
    listener = Listener("tls://127.0.0.1:0?maximum_version=1.3&minimum_version=1.3", tls=tls)
    with busway.serve_in_thread(listener, units=device()) as server:
        with foreign_client(port_of(server), foreign_context(operator, operator)) as client:
            assert client.version() == "TLSv1.3"
        context = foreign_context(operator, operator, TlsVersion.TLS_1_2)
        assert OF_SSL[TlsVersion.TLS_1_2] is context.maximum_version
        assert "PROTOCOL_VERSION" in try_to_read(port_of(server), context)

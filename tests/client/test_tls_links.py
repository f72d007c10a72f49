"""Links over TLS, both kinds: what they accept, what they refuse and what they say about it."""

import asyncio
import contextlib
import logging
import os
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from client_kinds import CLIENT_KINDS, ClientKind
from handles import open_handles
from tls_peers import OF_SSL, VERSIONS, one_version, query, receive_adu

import busway
from busway.errors import ConfigError, LinkDown, WriteOutcomeUnknown
from busway.options.tls import TlsVersion
from busway.testing.certificates import CertificateFiles, CertificateStore

REGISTER = 1234
Store = CertificateStore
Work = Callable[[str], object]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return Store(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def good_server(store: Store) -> CertificateFiles:
    return store.server()


@pytest.fixture(scope="module")
def operator(store: Store) -> CertificateFiles:
    return store.client("operator", role="Operator")


@pytest.fixture(scope="module", autouse=True)
def first_loop(good_server: CertificateFiles) -> None:
    """The first event loop of a process opens handles that stay; they are no leak."""
    with served(good_server):
        pass


@contextlib.contextmanager
def served(files: CertificateFiles, more: str = "") -> Iterator[tuple[str, busway.Device]]:
    """Our server with a certificate; where it is reached by name, and its device."""
    device = busway.Device(holding_registers=[REGISTER, *range(1, 200)])
    with busway.serve_in_thread(f"tls://127.0.0.1:0?{files.query()}{more}", units=device) as server:
        yield server.endpoints[0].replace("127.0.0.1", "localhost"), device


def read_blocking(url: str) -> object:
    with busway.connect(url) as link:
        return link.unit(1).read_holding_registers(0, count=1)


def read_on_a_loop(url: str) -> object:
    async def read() -> object:
        async with busway.open(url) as link:
            return await link.unit(1).read_holding_registers(0, count=1)

    return asyncio.run(read())


def write_blocking(url: str) -> object:
    with busway.connect(url) as link:
        link.unit(1).write_single_register(0, 7)
    return None


def write_on_a_loop(url: str) -> object:
    async def write() -> None:
        async with busway.open(url) as link:
            await link.unit(1).write_single_register(0, 7)

    return asyncio.run(write())


def read_on_uvloop(url: str) -> object:
    uvloop = pytest.importorskip("uvloop")

    async def read() -> object:
        async with busway.open(url) as link:
            return await link.unit(1).read_holding_registers(0, count=1)

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(read())


READERS: dict[str, Work] = {"blocking": read_blocking, "asyncio": read_on_a_loop, "uvloop": read_on_uvloop}
WRITERS: dict[str, Work] = {"blocking": write_blocking, "asyncio": write_on_a_loop, "uvloop": write_on_a_loop}
both_kinds = pytest.mark.parametrize("via", READERS)
versions = pytest.mark.parametrize("version", VERSIONS)


@pytest.mark.clause("M1")
@pytest.mark.clause("M2")
@both_kinds
@versions
def test_both_sides_agree_and_registers_are_read(
    good_server: CertificateFiles, operator: CertificateFiles, via: str, version: TlsVersion
) -> None:
    handles = open_handles()
    with served(good_server) as (url, _):
        options = query({**operator.options(), **one_version(version)})
        assert READERS[via](f"{url}?{options}") == [REGISTER]
    assert open_handles() == handles


@both_kinds
def test_without_an_authority_nothing_is_dialled(via: str) -> None:
    with pytest.raises(ConfigError, match="the authority that the server's certificate comes from is needed"):
        READERS[via]("tls://localhost:1")


@both_kinds
def test_an_ip_address_in_the_certificate_is_a_name_too(
    good_server: CertificateFiles, operator: CertificateFiles, via: str
) -> None:
    with served(good_server) as (url, _):
        assert READERS[via](f"{url.replace('localhost', '127.0.0.1')}?{operator.query()}") == [REGISTER]


@both_kinds
def test_a_server_may_be_called_by_another_name(store: Store, operator: CertificateFiles, via: str) -> None:
    with served(store.server("plc", hosts=["plc-7"])) as (url, _):
        assert READERS[via](f"{url}?{operator.query()}&server_name=plc-7") == [REGISTER]


BAD_SERVERS: dict[str, tuple[Callable[[Store], CertificateFiles], str]] = {
    "expired": (
        lambda store: store.expired_server(),
        "the server's certificate has expired on 20",
    ),
    "not yet valid": (
        lambda store: store.write("early", store.authority.server(["localhost"], days=30, starts_in=20)),
        "the server's certificate is not valid before 20",
    ),
    "of an expired authority": (
        lambda store: store.server("late", authority=store.authority.intermediate("old authority", days=-1)),
        "the certificate of an authority above the server's has expired",
    ),
    "self-signed": (
        lambda store: store.self_signed(),
        "the server's certificate is signed by itself, and not by an authority that is known here",
    ),
    "foreign": (
        lambda store: store.server("stranger", authority=store.foreign),
        "the server's certificate is signed by an authority that is not known here",
    ),
    "another name": (
        lambda store: store.server("other", hosts=["other.example"]),
        "the server's certificate is for another name: Hostname mismatch, certificate is not valid for 'localhost'.",
    ),
    "a client's": (
        lambda store: store.client("posing", role="Operator"),
        "the server's certificate is not meant for this purpose (extended key usage)",
    ),
}


@pytest.mark.clause("M3")
@both_kinds
@versions
@pytest.mark.parametrize("case", BAD_SERVERS)
def test_a_server_with_a_bad_certificate_is_not_believed(
    store: Store, operator: CertificateFiles, case: str, version: TlsVersion, via: str
) -> None:
    make, sentence = BAD_SERVERS[case]
    handles = open_handles()
    with served(make(store)) as (url, device):
        options = query({**operator.options(), **one_version(version)})
        for work in (READERS[via], WRITERS[via]):
            with pytest.raises(LinkDown) as caught:
                work(f"{url}?{options}")
            assert caught.value.message.startswith(f"no connection: {sentence}")
            assert not caught.value.sent
        assert device.holding_registers[0] == REGISTER
    assert open_handles() == handles


@both_kinds
def test_verification_is_switched_off_by_a_loud_name_only(
    store: Store, operator: CertificateFiles, via: str, caplog: pytest.LogCaptureFixture
) -> None:
    with served(store.self_signed()) as (url, _):
        assert READERS[via](f"{url}?{operator.query()}&verify=off-insecure") == [REGISTER]
        assert READERS[via](f"{url}?{operator.query()}&verify=off-insecure") == [REGISTER]
        assert caplog.text.count("any host that answers there is taken for the server (verify=off-insecure)") == 2
        for text in ("off", "false", "none"):
            with pytest.raises(ConfigError, match="verify"):
                READERS[via](f"{url}?{operator.query()}&verify={text}")


REFUSALS: dict[str, tuple[Callable[[Store], CertificateFiles | None], str, str]] = {
    # How it is said by TLS 1.2, and by 1.3.
    "none": (
        lambda store: None,
        "the server refused: there is nothing to agree on (no suite in common, or it wants a certificate)",
        "the server refused: it wants a certificate, and was given none",
    ),
    "expired": (
        lambda store: store.expired_client(),
        "the server refused: it says that our certificate has expired",
        "the server refused: it says that our certificate has expired",
    ),
    "self-signed": (
        lambda store: store.self_signed("self-signed client"),
        "the server refused: it does not know the authority of our certificate",
        "the server refused: it does not know the authority of our certificate",
    ),
    "foreign": (
        lambda store: store.client("stranger", authority=store.foreign),
        "the server refused: it does not know the authority of our certificate",
        "the server refused: it does not know the authority of our certificate",
    ),
    "a server's": (
        lambda store: store.server("posing server"),
        "the server refused: it says that our certificate is not meant for this",
        "the server refused: it says that our certificate is not meant for this",
    ),
}


@pytest.mark.clause("M3")
@both_kinds
@versions
@pytest.mark.parametrize("case", REFUSALS)
def test_a_refusal_of_our_certificate_is_told_by_its_reason(
    store: Store, good_server: CertificateFiles, case: str, version: TlsVersion, via: str
) -> None:
    make, by_12, by_13 = REFUSALS[case]
    sentence = by_12 if version is TlsVersion.TLS_1_2 else by_13
    files = make(store)
    options = {"authority": str(store.authority_file)} if files is None else dict(files.options())
    handles = open_handles()
    with served(good_server) as (url, device):
        with pytest.raises(LinkDown) as caught:
            READERS[via](f"{url}?{query({**options, **one_version(version)})}")
        assert sentence in caught.value.message
        # A client of TLS 1.3 has sent its request before it can know that it is not wanted.
        with pytest.raises(LinkDown if version is TlsVersion.TLS_1_2 else WriteOutcomeUnknown) as refused:
            WRITERS[via](f"{url}?{query({**options, **one_version(version)})}")
        assert sentence in f"{refused.value} {refused.value.__cause__}"
        assert device.holding_registers[0] == REGISTER
    assert open_handles() == handles


@both_kinds
def test_a_server_that_is_no_tls_is_told(store: Store, operator: CertificateFiles, via: str) -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units=busway.Device(coils=1)) as server:
        port = server.endpoints[0].rpartition(":")[2]
        with pytest.raises(LinkDown, match="no connection: "):
            READERS[via](f"tls://localhost:{port}?{operator.query()}&handshake_timeout=0.5")


@both_kinds
def test_a_server_that_never_answers_the_handshake_is_given_up(operator: CertificateFiles, via: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        handles = open_handles()
        with pytest.raises(LinkDown, match=r"TLS was not agreed on within 0\.2 s"):
            READERS[via](f"tls://127.0.0.1:{port}?{operator.query()}&handshake_timeout=0.2")
        assert open_handles() == handles


@both_kinds
def test_a_server_that_closes_within_the_handshake_is_told(operator: CertificateFiles, via: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def close_each() -> None:
            with contextlib.suppress(OSError):
                while True:
                    accepted, _ = listener.accept()
                    accepted.recv(10_000)
                    accepted.close()

        closing = threading.Thread(target=close_each)
        closing.start()
        port = listener.getsockname()[1]
        with pytest.raises(LinkDown, match="closed the connection before both sides had agreed"):
            READERS[via](f"tls://127.0.0.1:{port}?{operator.query()}")
        listener.shutdown(socket.SHUT_RDWR)
        closing.join()


@pytest.mark.clause("M1")
@versions
@pytest.mark.parametrize("via", ["blocking", "asyncio"])
@pytest.mark.parametrize("sizes", [(1,), (7,), (11, 1, 3)], ids=str)
def test_replies_may_be_cut_into_records_anywhere(
    good_server: CertificateFiles, operator: CertificateFiles, sizes: tuple[int, ...], via: str, version: TlsVersion
) -> None:
    """Two requests in flight, whose replies come as records of odd sizes, more than one in a segment."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = context.maximum_version = OF_SSL[version]
    context.load_cert_chain(good_server.certificate, good_server.key)
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            accepted, _ = listener.accept()
            with context.wrap_socket(accepted, server_side=True) as server:
                while request := receive_adu(server):
                    count = int.from_bytes(request[10:12], "big")
                    pdu = bytes([3, 2 * count]) + b"".join(n.to_bytes(2, "big") for n in range(count))
                    reply = request[:4] + (len(pdu) + 1).to_bytes(2, "big") + request[6:7] + pdu
                    at = turn = 0
                    while at < len(reply):
                        size = sizes[turn % len(sizes)]
                        server.sendall(reply[at : at + size])
                        at, turn = at + size, turn + 1

        answering = threading.Thread(target=answer)
        answering.start()
        port = listener.getsockname()[1]
        url = f"tls://127.0.0.1:{port}?authority={operator.authority}"
        if via == "blocking":
            with busway.connect(url) as link:
                for count in (1, 100, 125):
                    assert link.unit(1).read_holding_registers(0, count=count) == list(range(count))
        else:

            async def read() -> None:
                async with busway.open(url) as link:
                    for count in (1, 100, 125):
                        assert await link.unit(1).read_holding_registers(0, count=count) == list(range(count))

            asyncio.run(read())
        answering.join()


def test_a_blocking_link_that_sends_much_at_once_loses_nothing(
    good_server: CertificateFiles, operator: CertificateFiles
) -> None:
    """Many threads, small buffers: what the socket does not take at once goes out later, and once."""
    with served(good_server) as (url, _):
        options = f"{operator.query()}&max_transactions=16&send_buffer=1024&receive_buffer=1024"
        with busway.connect(f"{url}?{options}", timeout=10.0) as link:
            unit = link.unit(1)
            unit.read_holding_registers(0, count=1)
            wrong: list[object] = []

            def work(own: int) -> None:
                for _ in range(10):
                    unit.write_multiple_registers(own * 10, [own] * 10)
                    got = unit.read_holding_registers(own * 10, count=10)
                    if got != [own] * 10:
                        wrong.append(got)

            threads = [threading.Thread(target=work, args=(own,)) for own in range(1, 17)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
    assert wrong == []


@pytest.mark.parametrize("via", CLIENT_KINDS, ids=lambda via: via.name)
def test_a_connection_that_the_server_closed_while_idle_is_dialled_again(
    good_server: CertificateFiles, operator: CertificateFiles, via: ClientKind
) -> None:
    device = busway.Device(holding_registers=[REGISTER])
    url = f"tls://127.0.0.1:0?{good_server.query()}&max_handshakes=1"
    with busway.serve_in_thread(url, units=device, max_connections=1) as server:
        port = server.endpoints[0].rpartition(":")[2]
        with via.link(f"tls://localhost:{port}?{operator.query()}") as link:
            unit = link.unit(1)
            assert unit.read_holding_registers(0, count=1) == [REGISTER]
            for _ in range(3):
                assert read_blocking(f"tls://127.0.0.1:{port}?{operator.query()}") == [REGISTER]  # takes its place
                link.breathe()
                assert unit.read_holding_registers(0, count=1) == [REGISTER]


def test_two_users_with_different_certificates_do_not_share_a_link(
    store: Store, good_server: CertificateFiles, operator: CertificateFiles
) -> None:
    other = store.client("viewer", role="Viewer")
    with served(good_server) as (url, _), busway.connect(f"{url}?{operator.query()}") as first:
        first.unit(1).read_holding_registers(0, count=1)
        with pytest.raises(ConfigError, match="certificate"), busway.connect(f"{url}?{other.query()}") as second:
            second.unit(1).read_holding_registers(0, count=1)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"require_role": "on"}, "require_role: unknown option"),
        ({"minimum_version": "1.1"}, "minimum_version: must be one of 1.2, 1.3, not '1.1'"),
        ({"minimum_version": "1.3", "maximum_version": "1.2"}, "must not be above maximum_version, 1.2"),
        ({"ciphers": "AES128-SHA"}, "'AES128-SHA' is none of the suites"),
        ({"ciphers": ","}, "at least one suite is needed"),
        ({"handshake_timeout": "0"}, "handshake_timeout: must be 0.1…600"),
        ({"key": "x.key"}, "there is a key, but no certificate"),
    ],
)
def test_options_that_cannot_be_are_refused(operator: CertificateFiles, options: dict[str, str], sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_blocking(f"tls://localhost:1?{query({'authority': operator.authority, **options})}")
    assert sentence in str(caught.value)


def test_the_options_of_tls_mean_nothing_to_other_schemes() -> None:
    with pytest.raises(ConfigError, match="certificate: unknown option"):
        read_blocking("tcp://localhost:1?certificate=x.pem")


def test_a_failed_handshake_is_logged_once_as_a_change_of_state(
    store: Store, operator: CertificateFiles, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "busway.client")
    with served(store.expired_server()) as (url, _), pytest.raises(LinkDown):
        read_blocking(f"{url}?{operator.query()}")
    assert "the server's certificate has expired" in caplog.text


def test_an_own_certificate_that_expires_is_said_when_the_link_is_made(
    store: Store, good_server: CertificateFiles, caplog: pytest.LogCaptureFixture
) -> None:
    ageing, fresh = store.client("ageing", days=3.5), store.client("fresh", days=300)
    with served(good_server) as (url, _):
        for files in (fresh, ageing):
            assert read_blocking(f"{url}?{files.query()}") == [REGISTER]
    (warning,) = [record.getMessage() for record in caplog.records if "our certificate" in record.getMessage()]
    assert f"our certificate {ageing.certificate} expires on " in warning
    assert warning.endswith((", in 3 days", ", in 4 days"))


def test_a_client_does_without_the_package_that_a_listener_needs(
    good_server: CertificateFiles, operator: CertificateFiles, tmp_path: Path
) -> None:
    """In a process of its own, where ``cryptography`` cannot be found."""
    (tmp_path / "cryptography.py").write_text("raise ImportError('not here')")
    program = (
        "import busway, sys\n"
        "with busway.connect(sys.argv[1]) as link:\n"
        "    assert link.unit(1).read_holding_registers(0, count=1) == [1234]\n"
        "try:\n"
        "    with busway.serve_in_thread(sys.argv[2], units=busway.Device()):\n"
        "        pass\n"
        "except busway.ConfigError as error:\n"
        "    print(error)\n"
    )
    with served(good_server) as (url, _):
        done = subprocess.run(
            [sys.executable, "-c", program, f"{url}?{operator.query()}", f"tls://127.0.0.1:0?{good_server.query()}"],
            env={**os.environ, "PYTHONPATH": str(tmp_path)},
            capture_output=True,
            text=True,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    assert "a tls:// listener needs the package cryptography: pip install 'busway[tls]'" in done.stdout


def test_a_blocking_program_loads_no_tls_before_it_needs_it() -> None:
    program = "import busway, sys; busway.connect('tcp://h'); sys.exit('ssl' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


# --- a context of the program's own ------------------------------------------------------------------


def own_context(trusts: CertificateFiles, shows: CertificateFiles | None = None) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=str(trusts.authority))
    if shows is not None:
        context.load_cert_chain(shows.certificate, shows.key)
    return context


def read_with(context: ssl.SSLContext, url: str, via: str) -> object:
    if via == "blocking":
        with busway.connect(url, ssl_context=context) as link:
            return link.unit(1).read_holding_registers(0, count=1)

    async def read() -> object:
        async with busway.open(url, ssl_context=context) as link:
            return await link.unit(1).read_holding_registers(0, count=1)

    return asyncio.run(read())


@pytest.mark.parametrize("via", ["blocking", "asyncio"])
def test_a_context_of_the_programs_own_decides_what_is_trusted_and_shown(
    good_server: CertificateFiles, operator: CertificateFiles, via: str
) -> None:
    with served(good_server) as (url, _):
        assert read_with(own_context(operator, operator), url, via) == [REGISTER]
        assert read_with(own_context(operator, operator), f"{url}?handshake_timeout=30", via) == [REGISTER]
        with pytest.raises(LinkDown):
            read_with(ssl.create_default_context(), url, via)


@pytest.mark.parametrize("via", ["blocking", "asyncio"])
def test_an_expired_server_is_refused_with_a_context_of_ones_own_too(
    store: Store, operator: CertificateFiles, via: str
) -> None:
    with served(store.expired_server()) as (url, _), pytest.raises(LinkDown):
        read_with(own_context(operator, operator), url, via)


def test_a_context_has_its_place_and_contradicts_no_option(operator: CertificateFiles) -> None:
    context = own_context(operator)
    with pytest.raises(ConfigError, match=r"ssl_context: has no effect on tcp://"):
        busway.connect("tcp://127.0.0.1:1", ssl_context=context)
    with pytest.raises(ConfigError, match=r"authority: has no effect beside ssl_context"):
        busway.connect("tls://127.0.0.1:1", ssl_context=context, authority=str(operator.authority))
    with pytest.raises(ConfigError, match=r"verify: has no effect beside ssl_context"):
        busway.open("tls://127.0.0.1:1?verify=off-insecure", ssl_context=context)
    with pytest.raises(ConfigError, match=r"ssl_context: has no effect with select"):
        busway.connect("tls://127.0.0.1:1", select="first", ssl_context=context)


def test_links_with_different_contexts_share_no_connection(operator: CertificateFiles) -> None:
    context = own_context(operator)
    with busway.connect("tls://127.0.0.1:1", ssl_context=context):
        with busway.connect("tls://127.0.0.1:1", ssl_context=context):
            pass
        with pytest.raises(ConfigError, match="ssl_context"):
            busway.connect("tls://127.0.0.1:1", ssl_context=own_context(operator))

"""No error and no log line of a coordinator has a secret, from whatever place the secret is."""

import asyncio
import contextlib
import json
import logging
from collections.abc import AsyncIterator

import pytest

from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.coordinators.opening import CoordinatorOptions, hidden_secrets
from busway.errors import ConfigError, ModbusError

SECRET = "s3cret/of:west"
INFO = (
    b"INFO %s\r\n"
    % json.dumps(
        {"server_id": "a", "version": "2.9.0", "proto": 1, "max_payload": 1024, "auth_required": True}
    ).encode()
)


@pytest.mark.parametrize(
    ("url", "options", "text", "shown"),
    [
        ("nats://west:one@a", {}, "nats://west:one@a", "nats://west:***@a"),
        ("nats://west:one@a,east:two@b", {}, "one, two", "***, ***"),
        ("nats://of-token@a", {}, "nats://of-token@a", "nats://***@a"),
        ("nats://west:a%2Fb@a", {}, "a/b a%2Fb", "*** ***"),
        ("nats://a", {"password": "one", "token": "two"}, "one two", "*** ***"),
        ("postgresql://west@a/plant", {"password": "one"}, "west one", "west ***"),
        ("postgresql://west:on,e@a/plant", {}, "postgresql://west:on,e@a/plant", "postgresql://west:***@a/plant"),
        ("postgresql://a/plant?user=west&password=one", {}, "west one", "west ***"),
        ("nast://west:one@a", {}, "nast://west:one@a", "nast://west:***@a"),
        ("local:folder", {}, "local:folder", "local:folder"),
    ],
)
def test_secrets_of_the_url_and_of_the_options_are_hidden(
    url: str, options: dict[str, str], text: str, shown: str
) -> None:
    assert hidden_secrets(url, CoordinatorOptions(**options)).hide(text) == shown  # type: ignore[arg-type]


@contextlib.asynccontextmanager
async def echoing(greeting: bytes, answer: bytes) -> AsyncIterator[int]:
    """Yield the port of a server that refuses every client and sends back all that the client has said."""
    ended = asyncio.Event()

    async def answered(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(greeting)
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            said = await reader.readuntil(b"\r\n")
            writer.write(answer % said.strip())
            await writer.drain()
            await ended.wait()
        writer.close()

    server = await asyncio.start_server(answered, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        ended.set()
        server.close()
        await server.wait_closed()


async def refused(url: str, options: CoordinatorOptions) -> ModbusError:
    with pytest.raises(ModbusError) as caught:
        await open_coordinator(url, "hall", options)
    return caught.value


@pytest.mark.parametrize("place", ["the URL", "the options"])
async def test_a_refusal_by_nats_that_quotes_the_password_is_told_without_it(
    place: str, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("nats")
    caplog.set_level(logging.DEBUG)
    own = "s3cret%2Fof%3Awest" if place == "the URL" else None
    async with echoing(INFO, b"-ERR 'Authorization Violation of %s'\r\n") as port:
        url = f"nats://west:{own}@127.0.0.1:{port}" if own else f"nats://127.0.0.1:{port}"
        given = CoordinatorOptions(start=0) if own else CoordinatorOptions("west", SECRET, start=0)
        error = await refused(url, given)
    assert isinstance(error, ConfigError)
    assert "refuses the credentials" in str(error)
    for secret in (SECRET, own or SECRET):
        assert secret not in str(error) + repr(error.__dict__) + caplog.text


@pytest.mark.parametrize("scheme", ["nats", "postgresql", "nast"])
async def test_a_server_that_is_away_is_named_without_the_password_of_its_url(
    scheme: str, caplog: pytest.LogCaptureFixture
) -> None:
    for package in {"nats": ["nats"], "postgresql": ["asyncpg"]}.get(scheme, []):
        pytest.importorskip(package)
    caplog.set_level(logging.DEBUG)
    url = f"{scheme}://west:in-the-url@127.0.0.1:9"
    error = await refused(url, CoordinatorOptions(answer=0.5, start=0))
    assert f"{scheme}://west:***@127.0.0.1:9" in str(error)
    assert "in-the-url" not in str(error) + str(getattr(error, "endpoint", "")) + caplog.text

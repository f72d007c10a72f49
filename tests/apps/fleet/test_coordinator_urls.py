"""URLs of coordinators: what cannot be is refused in a sentence, before any connection, and without its secrets."""

import asyncio
from dataclasses import replace

import pytest

from busway.apps.fleet.coordinators.opening import CoordinatorOptions, open_coordinator
from busway.errors import ConfigError


@pytest.mark.parametrize(
    "url",
    [
        "nats://host:abc",
        "nats://host:99999",
        "nats://a,b:x",
        "nats://[::1",
        "nats://",
        "nats://:0",
        "nats://me:secret@",
        "tls://me:secret@h:abc",
        "postgresql://me:secret@h:abc/db",
        "postgresql://h:99999/db",
        "postgresql://[::1/db",
        "postgresql:///db?port=x",
        "local:",
        "[::1",
        "",
    ],
)
def test_a_url_that_cannot_be_is_refused_in_a_sentence(url: str) -> None:
    with pytest.raises(ConfigError) as refused:
        asyncio.run(open_coordinator(url, "hall"))
    assert refused.value.key == "coordinator"
    assert "secret" not in str(refused.value)


@pytest.mark.parametrize("url", ["tls://127.0.0.1:1", "nats://127.0.0.1:1", "postgresql://x@127.0.0.1:1/x"])
@pytest.mark.parametrize("name", ["ca", "certificate"])
def test_a_file_for_tls_that_is_not_there_is_refused_by_name_and_not_waited_for(url: str, name: str) -> None:
    pytest.importorskip("asyncpg" if url.startswith("postgresql") else "nats")
    options = replace(CoordinatorOptions(start=1.0), **{name: "/nothing.pem"})
    with pytest.raises(ConfigError, match="cannot be used for TLS") as refused:
        asyncio.run(open_coordinator(url, "hall", options))
    assert refused.value.file == "/nothing.pem"

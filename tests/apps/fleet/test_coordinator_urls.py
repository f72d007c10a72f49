"""URLs of coordinators: what cannot be is refused in a sentence, before any connection, and without its secrets."""

import asyncio

import pytest

from busway.apps.fleet.coordinators.opening import open_coordinator
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

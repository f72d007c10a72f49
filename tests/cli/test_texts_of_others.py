"""What devices and certificates say of themselves, wherever a command prints it or a server logs it."""

import json
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tls_peers import ask, foreign_client, foreign_context

import busway
from busway.cli.status_view import StatusSection, shown
from busway.framing.received import Direction
from busway.observe.wording import described, in_words
from busway.testing.certificates import CertificateStore

EVIL = "A\x1b[2J\nforged\r\u202eB\x9b1m\u2028"
"""Eight characters that must not reach a terminal."""


def acts(text: str) -> list[str]:
    """What is left in an output that a terminal would act upon."""
    return [each for each in text if not each.isprintable() and each != "\n"]


@pytest.fixture
def evil() -> Iterator[str]:
    """Where a device is served that puts what it likes into its texts."""
    text = EVIL.encode()
    registers = [int.from_bytes(text.ljust(40, b"\0")[at : at + 2], "big") for at in range(0, 40, 2)]
    device = busway.Device(
        holding_registers=registers, identification=dict.fromkeys(range(3), EVIL), server_id=text + b"\xff"
    )
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device, 255: device}) as server:
        yield server.endpoints[0]


@pytest.mark.parametrize(
    "arguments",
    [
        ["read", "{}", "4x1", "--type", "string:40:utf-8"],
        ["read", "{}", "4x1", "--type", "string:40:utf-8", "--csv"],
        ["read", "{}", "4x1", "--type", "string:40:utf-8", "--json"],
        ["read", "{}", "4x1", "--type", "string:40:utf-8", "-vvv"],
        ["identify", "{}"],
        ["identify", "{}", "--csv"],
        ["identify", "{}", "--json"],
        ["scan", "{}", "--units", "1"],
        ["scan", "{}", "--units", "1", "--json"],
        ["simulate", "--clone", "{}", "--range", "0-20"],
    ],
    ids=" ".join,
)
def test_no_text_of_a_device_reaches_the_terminal_as_it_came(
    run: Callable[..., Any], evil: str, arguments: list[str]
) -> None:
    result = run(*(each.format(evil) for each in arguments))
    assert result.code == 0
    assert result.out
    assert acts(result.out) == acts(result.err) == []
    assert not [line for line in (result.out + result.err).splitlines() if line.startswith("forged")]


def test_json_holds_the_text_of_a_register_as_it_is(run: Callable[..., Any], evil: str) -> None:
    told = json.loads(run("read", evil, "4x1", "--type", "string:40:utf-8", "--json").out)
    assert told["value"] == EVIL


def test_a_clone_says_what_the_device_says(run: Callable[..., Any], evil: str, tmp_path: Path) -> None:
    file = tmp_path / "clone.toml"
    assert run("simulate", "--clone", evil, "--range", "0-20", "--out", str(file)).code == 0
    assert acts(file.read_text(encoding="utf-8")) == []
    assert run("simulate", str(file), "--check").code == 0


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_identification_in_a_frame_is_escaped(run: Callable[..., Any], form: list[str]) -> None:
    text = EVIL.encode()
    reply = bytes.fromhex("2B 0E 01 01 00 00 01 00") + bytes([len(text)]) + text
    result = run("decode", reply.hex(), *form)
    assert acts(result.out) == []
    assert acts(in_words(described(reply, Direction.REPLY))) == []
    assert "\n" not in in_words(described(reply, Direction.REPLY))


def test_names_and_roles_of_certificates_are_escaped_in_a_status() -> None:
    assert acts(shown("subject", EVIL)) == []
    section = StatusSection(EVIL, ("subject",), [[EVIL]])
    assert acts(section.title + section.rows[0][0]) == []


@pytest.fixture
def store(tmp_path: Path) -> CertificateStore:
    return CertificateStore(tmp_path)


def test_what_certificates_say_is_escaped_where_it_is_shown(run: Callable[..., Any], store: CertificateStore) -> None:
    issued = store.authority.client(EVIL, role=EVIL)
    files = store.write("evil", issued)
    result = run("certs", "show", str(files.certificate))
    assert result.code == 0
    assert "A\\x1b[2J\\nforged\\r\\u202eB" in result.out
    assert acts(result.out) == []
    assert not [line for line in result.out.splitlines() if line.startswith("forged")]


def test_what_certificates_say_is_escaped_where_a_server_logs_it(
    store: CertificateStore, caplog: pytest.LogCaptureFixture
) -> None:
    files = store.write("evil", store.authority.client_with(EVIL, [b"\x13\x01x"]))
    policy = busway.Policy.of(busway.Rule.of(name="n", roles=["Operator"]), default="deny")
    request = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
    with (
        caplog.at_level(logging.DEBUG),
        busway.serve_in_thread(
            f"tls://127.0.0.1:0?{store.server().query()}", units=busway.Device(holding_registers=1), policy=policy
        ) as server,
        foreign_client(int(server.endpoints[0].rpartition(":")[2]), foreign_context(files, files)) as client,
    ):
        ask(client, request)
        status = server.status()
    assert "has no role" in caplog.text
    assert all(acts(record.getMessage()) == [] and "\n" not in record.getMessage() for record in caplog.records)
    assert acts(str(status)) == []

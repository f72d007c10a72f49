"""``busway fleet server-config``: files, secrets, and what is refused."""

import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("nkeys")

Run = Callable[..., Any]


def test_secrets_are_for_their_owner_alone_never_printed_and_never_overwritten(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "servers"
    words = ("fleet", "server-config", "hall", "--servers", "10.0.0.1,10.0.0.2,10.0.0.3", "--out", str(out))
    made = run(*words)
    assert made.code == 0, made.err
    assert [Path(line).name for line in made.out.splitlines()] == [
        "n1.conf", "n2.conf", "n3.conf", "accounts.conf", "hall-collector.nk", "hall-sink.nk", "hall-operator.nk",
        "status.nk",
    ]  # fmt: skip
    seeds = {path: path.read_bytes() for path in out.glob("*.nk")}
    assert len(set(seeds.values())) == 4
    texts = "".join(path.read_text() for path in out.glob("*.conf"))
    for path, seed in seeds.items():
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert seed.strip().decode() not in made.out + made.err + texts
    accounts = (out / "accounts.conf").read_text()
    again = run(*words)
    assert (again.code, "n1.conf: is there already" in again.err) == (2, True)
    (out / "n1.conf").write_text("changed")
    assert run(*words, "--force").code == 0
    assert "server_name" in (out / "n1.conf").read_text()
    assert (out / "accounts.conf").read_text() == accounts, "users are the same as before"
    assert {path: path.read_bytes() for path in out.glob("*.nk")} == seeds
    (out / "hall-sink.nk").unlink()
    assert run(*words, "--force").code == 0
    assert (out / "accounts.conf").read_text() != accounts


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("hall",), "--out: is needed"),
        (("hall", "--out", "{out}", "--servers", "a,b"), "one server, or three or five"),
        (("hall", "--out", "{out}", "--servers", "a,b,a"), "two servers have one name or one address"),
        (("hall", "--out", "{out}", "--servers", "a;b"), "a server is [NAME=]HOST[:PORT], not 'a;b'"),
        (("hall", "--out", "{out}", "--servers", "a:64000"), "a server is [NAME=]HOST[:PORT]"),
        (("hall", "--out", "{out}", "--server-version", "2.8"), "from 2.9 on, not '2.8'"),
        (("hall", "--out", "{out}", "--sites", "10.7.0.1"), "a site is ZONE=HOST[:PORT] with a zone of its own"),
        (("hall", "--out", "{out}", "--sites", "hall=10.7.0.1"), "a site is ZONE=HOST[:PORT] with a zone of its own"),
        (("ha ll", "--out", "{out}"), "zone 'ha ll' cannot be a name"),
    ],
)
def test_what_is_wrong_is_said_and_nothing_is_written(
    run: Run, tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    out = tmp_path / "servers"
    found = run("fleet", "server-config", *(word.format(out=out) for word in words))
    assert (found.code, said in found.err) == (2, True), found.err
    assert not out.exists()


def test_a_file_that_is_no_seed_is_kept_and_refused(run: Run, tmp_path: Path) -> None:
    (tmp_path / "hall-sink.nk").write_text("my shopping list")
    found = run("fleet", "server-config", "hall", "--out", str(tmp_path))
    assert (found.code, "hall-sink.nk: holds no seed of a user" in found.err) == (2, True), found.err
    assert (tmp_path / "hall-sink.nk").read_text() == "my shopping list"
    assert not list(tmp_path.glob("*.conf"))


def test_options_of_the_servers_are_refused_elsewhere(run: Run) -> None:
    found = run("fleet", "status", "--out", "x", "--coordinator", "nats://127.0.0.1:1")
    assert (found.code, "--out: is for server-config" in found.err) == (2, True), found.err


def test_a_credentials_file_that_is_no_seed_is_named(run: Run, tmp_path: Path) -> None:
    seed = tmp_path / "west.nk"
    seed.write_text("SUnothing")
    found = run("fleet", "status", "--coordinator", "nats://127.0.0.1:1", "--credentials", str(seed))
    assert (found.code, "west.nk: holds no seed of a user" in found.err) == (2, True), found.err
    missing = run("fleet", "status", "--coordinator", "nats://127.0.0.1:1", "--credentials", str(tmp_path / "no.nk"))
    assert (missing.code, "no.nk" in missing.err) == (2, True), missing.err


def test_passwords_of_sites_are_in_secret_files_alone(run: Run, tmp_path: Path) -> None:
    words = ("fleet", "server-config", "hall", "--out", str(tmp_path), "--sites", "yard=10.7.0.1,mill=10.8.0.1:4300")
    made = run(*words)
    assert made.code == 0, made.err
    password = (tmp_path / "yard-leaf.secret").read_text().strip()
    holders = {path.name for path in tmp_path.iterdir() if password in path.read_text()}
    assert holders == {"yard-leaf.secret", "yard-leaf.conf", "leafs.conf"}
    assert all(stat.S_IMODE((tmp_path / name).stat().st_mode) == 0o600 for name in holders)
    assert password not in made.out + made.err
    assert run(*words, "--force").code == 0
    assert (tmp_path / "yard-leaf.secret").read_text().strip() == password

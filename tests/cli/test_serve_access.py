"""`busway serve` and who may do what: the network without a policy, policies, address lists, the audit log, SIGHUP."""

import json
import re
import signal
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from program import Busway

import busway
from busway.testing.certificates import CertificateStore

LOOPBACK = "tcp://127.0.0.1:0"
NETWORK = "tcp://0.0.0.0:0"

FILE = """\
listen = ["tcp://127.0.0.1:0"]

[policy]
default = "{default}"
{rest}
[[unit]]
unit = 1
holding_registers = 10
"""


SECURE = """\
[[listener]]
url = "tls://127.0.0.1:0"
require_role = true

[security]
certificate = "{certificate}"
key = "{key}"
authority = "{authority}"

[policy]
default = "read-only"

[[policy.rule]]
roles = ["operator"]
functions = ["write"]
addresses = "4x1"

[[unit]]
unit = 1
holding_registers = 10
"""


@contextmanager
def serving(*arguments: str) -> Iterator[tuple[Busway, str]]:
    """The running process, and a URL of this host at which its first listener answers."""
    with Busway("serve", *arguments, "--control", "off") as program:
        stdout = program.process.stdout
        assert stdout is not None
        endpoint = stdout.readline().decode().strip()
        assert endpoint, program.end()[1]
        yield program, endpoint.replace("0.0.0.0", "127.0.0.1")


def write(url: str) -> str:
    """Write a register: ``done``, or why not."""
    with busway.connect(url, shared=False, retries=0) as link:
        assert link.unit(1).read_holding_registers(0, count=1) is not None
        try:
            link.unit(1).write_single_register(0, 7)
        except busway.ExceptionReply as error:
            return f"exception {error.code:02X}"
        return "done"


@pytest.mark.clause("T20")
def test_a_listener_that_the_network_reaches_is_read_only_without_a_policy_and_the_command_says_so() -> None:
    with serving("--listen", NETWORK) as (program, url):
        assert write(url) == "exception 01"
        said = program.wait_for("read-only")
        assert re.fullmatch(
            r"busway: read-only, for want of a policy: tcp://0\.0\.0\.0:\d+; --allow-writes takes writes", said
        )
        out, _ = program.stop(signal.SIGTERM)
        assert program.process.returncode == 0
        assert out == ""


def test_writes_from_the_network_can_be_allowed_by_name() -> None:
    with serving("--listen", NETWORK, "--allow-writes") as (program, url):
        assert write(url) == "done"
        _, said = program.stop()
        assert program.process.returncode == 0
        assert "read-only" not in said.lower()


def test_loopback_takes_writes_also_beside_a_listener_that_does_not() -> None:
    with Busway("serve", "--listen", LOOPBACK, "--listen", NETWORK, "--control", "off") as program:
        assert program.process.stdout is not None
        local, network = (program.process.stdout.readline().decode().strip() for _ in range(2))
        assert write(local) == "done"
        assert write(network.replace("0.0.0.0", "127.0.0.1")) == "exception 01"


def test_a_policy_that_was_written_decides_alone(tmp_path: Path) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text('policy = "allow"\n')
    with serving("--listen", NETWORK, "--policy", str(policy)) as (_, url):
        assert write(url) == "done"
    with serving("--listen", LOOPBACK, "--policy", "read-only") as (_, url):
        assert write(url) == "exception 01"


@pytest.mark.clause("T15")
@pytest.mark.parametrize(
    ("arguments", "welcome"),
    [
        (("--deny", "127.0.0.0/8"), False),
        (("--allow", "10.0.0.0/8"), False),
        (("--allow", "10.0.0.0/8", "--allow", "127.0.0.1"), True),
    ],
)
def test_who_may_connect_is_said_by_address(arguments: tuple[str, ...], welcome: bool) -> None:
    with serving("--listen", LOOPBACK, *arguments) as (_, url):
        if welcome:
            assert write(url) == "done"
        else:
            with pytest.raises((busway.NoReply, busway.LinkDown)):
                write(url)


@pytest.mark.parametrize("option", ["--allow", "--deny", "--priority"])
def test_what_is_no_network_is_named(option: str) -> None:
    with Busway("serve", "--listen", LOOPBACK, option, "10.0.0.1/8") as program:
        _, said = program.end()
        assert program.process.returncode == 2
        (sentence,) = said.splitlines()
        assert sentence.startswith(f"busway: {option}: '10.0.0.1/8' has bits set")


def test_a_policy_file_that_is_wrong_is_refused_with_its_line(tmp_path: Path) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text('[policy]\ndefault = "some"\n')
    with Busway("serve", "--listen", LOOPBACK, "--policy", str(policy)) as program:
        out, said = program.end()
    assert (program.process.returncode, out) == (2, "")
    assert said.startswith(f"{policy}:2: policy.default: must be ")


def test_denied_requests_and_writes_stand_in_the_audit_log(tmp_path: Path) -> None:
    log = tmp_path / "audit.jsonl"
    with serving("--listen", NETWORK, "--audit", str(log)) as (program, url):
        assert write(url) == "exception 01"
        program.stop(signal.SIGTERM)
    (line,) = log.read_text().splitlines()
    entry = json.loads(line)
    assert "beyond-loopback" in entry.values()


def test_metrics_are_offered_where_they_are_wanted(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(FILE.format(default="allow", rest="") + '[metrics]\nlisten = "127.0.0.1:0"\n')
    with serving(str(file)) as (program, url):
        place = re.search(r"http://\S+", program.wait_for("metrics"))
        assert place is not None
        assert write(url) == "done"
        with urllib.request.urlopen(place[0], timeout=60) as answer:
            assert b"busway_" in answer.read()


def test_a_place_for_metrics_that_cannot_be_is_refused_by_the_name_of_the_option(run: Callable[..., Any]) -> None:
    done = run("serve", "--metrics", "here")
    assert done.code == 2
    assert done.err == "busway: --metrics: an address such as 127.0.0.1:9502 is needed, not 'here'\n"


def reloaded(program: Busway) -> str:
    """What it says of its files, read again."""
    program.process.send_signal(signal.SIGHUP)
    return program.wait_for("read again")


@pytest.mark.clause("T33")
def test_sighup_replaces_the_policy_and_keeps_connections(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(FILE.format(default="read-only", rest=""))
    with serving(str(file), "--audit", str(tmp_path / "audit.jsonl")) as (program, url):
        with busway.connect(url, shared=False, retries=0) as link:
            with pytest.raises(busway.ExceptionReply, match="exception 01"):
                link.unit(1).write_single_register(0, 1)
            file.write_text(FILE.format(default="allow", rest=""))
            (tmp_path / "audit.jsonl").rename(tmp_path / "audit.1")
            assert reloaded(program) == ("busway: read again: the audit log was opened anew; the policy was replaced")
            link.unit(1).write_single_register(0, 2)  # on the same connection
        program.stop(signal.SIGTERM)
    assert len((tmp_path / "audit.1").read_text().splitlines()) == 1
    assert len((tmp_path / "audit.jsonl").read_text().splitlines()) == 1


@pytest.mark.clause("T33")
def test_a_wrong_file_changes_nothing_and_what_is_wrong_is_said(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(FILE.format(default="allow", rest=""))
    with serving(str(file)) as (program, url):
        file.write_text(FILE.format(default="some", rest=""))
        assert "nothing was changed" in reloaded(program)
        assert program.wait_for("policy.default").startswith(f"{file}:4: policy.default: must be ")
        assert write(url) == "done"


def test_sighup_ends_the_connection_of_a_host_that_is_now_denied(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(FILE.format(default="allow", rest=""))
    with serving(str(file)) as (program, url), busway.connect(url, shared=False, retries=0) as link:
        link.unit(1).write_single_register(0, 1)
        file.write_text(FILE.format(default="allow", rest="deny = ['127.0.0.1']\n"))
        assert reloaded(program).endswith("connections of hosts that may no longer connect were ended: 1")
        with pytest.raises((busway.LinkDown, busway.NoReply, busway.WriteOutcomeUnknown)):
            link.unit(1).write_single_register(0, 2)


def test_what_only_the_next_start_will_see_is_named(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(FILE.format(default="allow", rest=""))
    with serving(str(file)) as (program, url):
        file.write_text(FILE.format(default="allow", rest="[server]\nmax_connections = 3\n").replace("10", "20"))
        assert reloaded(program) == "busway: read again: only the next start will see server, unit"
        file.write_text(FILE.format(default="allow", rest="deny = ['127.0.0.1']\n"))
        assert "the policy was replaced" in reloaded(program)
        with pytest.raises((busway.NoReply, busway.LinkDown)):
            write(url)


def test_the_lists_of_a_listener_are_replaced_too(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    text = '[[listener]]\nurl = "tcp://127.0.0.1:0"\ndeny = ["{}"]\n[[unit]]\nunit = 1\nholding_registers = 10\n'
    file.write_text(text.format("127.0.0.1"))
    with serving(str(file)) as (program, url):
        with pytest.raises((busway.NoReply, busway.LinkDown)):
            write(url)
        file.write_text(text.format("10.0.0.1"))
        assert reloaded(program) == "busway: read again: the address lists of listeners were replaced"
        assert write(url) == "done"


@pytest.mark.clause("T33")
@pytest.mark.clause("M6")
def test_one_file_serves_over_tls_with_roles_and_certificates_that_can_be_replaced(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    host, operator = store.server(), store.client("operator", role="operator")
    file = tmp_path / "plant.toml"
    file.write_text(SECURE.format(**host.options()), encoding="utf-8")
    with serving(str(file)) as (program, url):
        client = tmp_path / "client.toml"
        client.write_text(
            "[security]\n"
            + "".join(f'{name} = "{path}"\n' for name, path in operator.options().items())
            + f'[[link]]\nname = "plant"\nurl = "{url}"\nretries = 0\n'
        )
        with busway.load_configuration(client).connect("plant", shared=False) as link:
            link.unit(1).write_single_register(0, 7)
            with pytest.raises(busway.ExceptionReply, match="exception 01"):
                link.unit(1).write_single_register(1, 7)
        certificate = Path(host.options()["certificate"])
        certificate.rename(tmp_path / "kept.pem")
        assert "nothing was changed" in reloaded(program)
        (tmp_path / "kept.pem").rename(certificate)
        assert reloaded(program) == "busway: read again: certificates hold from the next connection on"

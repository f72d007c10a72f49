"""The unit file: what it says for which gateway, and that systemd reads it where there is one."""

import shutil
import subprocess
from pathlib import Path

import pytest

from busway.apps.gateway.configuration import parse_gateway
from busway.cli.systemd_unit import ServiceUnit, program, quoted

LINES = {
    "tcp": '[[link]]\nname = "x"\nurl = "tcp://10.0.0.5"\n',
    "rtu": '[[link]]\nname = "x"\nurl = "rtu:///dev/not-there"\n',
}


def unit(listen: str, line: str, *, rest: str = "", **options: object) -> dict[str, str]:
    """The directives of the unit of a gateway, by name."""
    plan = parse_gateway(f'listen = ["{listen}"]\n{rest}{LINES[line]}', "x").plan
    made = ServiceUnit(["/usr/bin/busway", "gateway", "/etc/x.toml"], plan, 7.5, **options)  # type: ignore[arg-type]
    pairs = [row.split("=", 1) for row in made.text().splitlines() if "=" in row and row[0] != "#"]
    return dict(pairs)


def test_it_notifies_reloads_by_hangup_and_waits_for_the_drain() -> None:
    said = unit("tcp://127.0.0.1:5020", "tcp", name="plant")
    assert said["Type"] == "notify"
    assert said["ExecStart"] == "/usr/bin/busway gateway /etc/x.toml --control /run/busway/plant.sock"
    assert said["ExecReload"] == "/bin/kill -HUP $MAINPID"
    assert said["TimeoutStopSec"] == "12"
    assert said["RestartPreventExitStatus"] == "2"
    assert int(said["WatchdogSec"]) > 0


@pytest.mark.parametrize(
    ("listen", "rest", "needed"),
    [
        ("tcp://127.0.0.1:5020", "", False),
        ("tcp://127.0.0.1:502", "", True),
        ("tls://10.0.0.1:802", '[security]\ncertificate = "c"\nkey = "k"\nauthority = "a"\n', True),
        ("tcp://10.0.0.1:5020", "", True),  # 502 stands beside it
        ("tcp://10.0.0.1:5020", "[server]\nstandard_port = false\n", False),
        ("tcp://127.0.0.1:5020", "[server]\nstandard_port = true\n", True),
        ("udp://10.0.0.1:5020", "", False),
        ("rtu:///dev/not-there-2", "", False),
    ],
)
def test_low_ports_are_its_right_only_where_it_listens_on_one(listen: str, rest: str, needed: bool) -> None:
    said = unit(listen, "tcp", rest=rest)
    assert said["CapabilityBoundingSet"] == ("CAP_NET_BIND_SERVICE" if needed else "")
    assert ("AmbientCapabilities" in said) is needed


def test_devices_are_its_own_only_where_there_is_a_port() -> None:
    assert unit("tcp://127.0.0.1:5020", "rtu")["SupplementaryGroups"] == "dialout"
    assert "PrivateDevices" not in unit("tcp://127.0.0.1:5020", "rtu")
    assert unit("tcp://127.0.0.1:5020", "tcp")["PrivateDevices"] == "yes"
    assert "SupplementaryGroups" not in unit("tcp://127.0.0.1:5020", "tcp")
    assert unit("rtu:///dev/not-there-2", "tcp")["SupplementaryGroups"] == "dialout"


def test_folders_that_are_written_are_named_and_a_program_at_home_is_reachable() -> None:
    said = unit("tcp://127.0.0.1:5020", "tcp", written=["/var/log/my plant"])
    assert said["ReadWritePaths"] == '"/var/log/my plant"'
    assert said["ProtectHome"] == "yes"
    assert unit("tcp://127.0.0.1:5020", "tcp", written=["/home/me/logs"])["ProtectHome"] == "read-only"


@pytest.mark.parametrize(
    ("word", "written"),
    [
        ("/etc/x.toml", "/etc/x.toml"),
        ("a b", '"a b"'),
        ("", '""'),
        ("50%", "50%%"),
        ("$HOME", "$$HOME"),
        ('a"b', '"a\\"b"'),
        ("a\\b", '"a\\\\b"'),
        ("rtu:///dev/x?baud=9600&parity=even", "rtu:///dev/x?baud=9600&parity=even"),
    ],
)
def test_words_are_written_so_that_systemd_reads_them_as_they_are(word: str, written: str) -> None:
    assert quoted(word) == written


def test_the_program_is_named_by_an_absolute_path() -> None:
    assert Path(program()[0]).is_absolute()
    assert Path(program()[0]).exists()


def test_the_control_socket_is_an_option_also_where_the_words_end_with_arguments() -> None:
    plan = parse_gateway(f'listen = ["tcp://127.0.0.1:5020"]\n{LINES["tcp"]}', "x").plan
    text = ServiceUnit(["/usr/bin/busway", "gateway", "--", "/etc/x.toml"], plan, 5).text()
    assert "ExecStart=/usr/bin/busway gateway --control /run/busway/gateway.sock -- /etc/x.toml\n" in text


def test_systemd_finds_nothing_wrong_with_it(tmp_path: Path) -> None:
    plan = parse_gateway(f'listen = ["tcp://127.0.0.1:5020"]\n{LINES["rtu"]}', "x").plan
    text = ServiceUnit([*program(), "gateway", "/etc/a b.toml"], plan, 5, ["/var"]).text()
    file = tmp_path / "busway-gateway.service"
    file.write_text(text)
    sections = [line for line in text.splitlines() if line.startswith("[")]
    assert sections == ["[Unit]", "[Service]", "[Install]"]
    if shutil.which("systemd-analyze"):
        done = subprocess.run(
            ["systemd-analyze", "verify", str(file)], capture_output=True, text=True, timeout=60, check=False
        )
        assert str(file) not in done.stderr
        assert file.name not in done.stderr

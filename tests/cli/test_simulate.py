"""`busway simulate`: as a process of its own, on several listeners, for a time or until a signal."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from program import Busway
from whole_frames import line_of_whole_frames

import busway
from busway.testing.certificates import CertificateStore

PROGRAM = [sys.executable, "-m", "busway", "simulate"]

FILE = """\
listen = ["tcp://127.0.0.1:0"]

[simulation]
keep = "state.json"

[[unit]]
unit = 3
name = "tank"

[[unit.point]]
name = "level"
address = "4x1"
type = "float32"
value = 2.5

[[unit.point]]
name = "pulses"
address = "3x1"
type = "uint32"
behaviour = { kind = "counter", rate = 1, every = 0.1 }

[[unit.point]]
name = "noise"
address = "3x3"
type = "float32"
behaviour = { kind = "noise", spread = 1, every = 1000 }
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A simulation file."""
    path = tmp_path / "tank.toml"
    path.write_text(FILE)
    return path


@contextmanager
def simulating(*arguments: str, listeners: int = 1) -> Iterator[tuple["subprocess.Popen[str]", Sequence[str]]]:
    """The running process, and the endpoints that it printed."""
    process = subprocess.Popen([*PROGRAM, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process:
        try:
            yield process, [process.stdout.readline().strip() for _ in range(listeners)]
        finally:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_points_behave_on_every_listener_until_a_signal_and_are_kept(number: signal.Signals, file: Path) -> None:
    urls = ["tcp://127.0.0.1:0", "udp://127.0.0.1:0", "rtu+tcp://127.0.0.1:0"]
    options = [word for url in urls for word in ("--listen", url)]
    with simulating(str(file), "--speed", "1000", *options, listeners=3) as (process, endpoints):
        found = []
        for endpoint in endpoints:
            with busway.connect(endpoint) as link:
                link.unit(3).write("4x1", 1.25, "float32")
                found.append(link.unit(3).read("3x1", "uint32"))
        deadline = time.monotonic() + 20
        with busway.connect(endpoints[0]) as link:
            while link.unit(3).read("3x1", "uint32") <= found[0]:
                assert time.monotonic() < deadline
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "Traceback" not in said
    state = json.loads((file.parent / "state.json").read_text())
    assert state["points"]["3/level"]["value"] == 1.25
    assert state["points"]["3/pulses"]["behaviour"] >= found[-1]


@contextmanager
def place(scheme: str, folder: Path) -> Iterator[tuple[str, str | None, dict[str, Any]]]:
    """Where to listen, what a client asks if that is another end, and its options."""
    if scheme == "tls":
        store = CertificateStore(folder)
        yield f"tls://127.0.0.1:0?{store.server().query()}", None, store.client().options()
    elif "+" in scheme:
        yield f"{scheme}://127.0.0.1:0", None, {}
    else:
        with line_of_whole_frames(ports=2, baud=38_400, data_bits=8 if scheme == "rtu" else 7) as line:
            here, there = (f"{scheme}://{path}?baud=38400" for path in line.paths)
            yield here, there, {}


@pytest.mark.parametrize("scheme", ["tls", "rtu", "ascii", "ascii+tcp"])
@pytest.mark.real_time
def test_points_writes_and_faults_are_the_same_on_every_transport(scheme: str, file: Path, tmp_path: Path) -> None:
    with place(scheme, tmp_path) as (listen, other_end, options):
        words = ["--listen", listen, "--speed", "1000", "--fault", "busy:functions=6"]
        with (
            simulating(str(file), *words) as (_, (endpoint,)),
            # A line loses a frame on a machine that pauses within it; the write is the same each time.
            busway.connect(other_end or endpoint, timeout=2, retries=5, write_retries=5, **options) as link,
        ):
            unit = link.unit(3)
            unit.write("4x1", 1.25, "float32")
            assert unit.read("4x1", "float32") == 1.25
            first = unit.read("3x1", "uint32")
            deadline = time.monotonic() + 20
            while unit.read("3x1", "uint32") == first:
                assert time.monotonic() < deadline
            with pytest.raises(busway.ExceptionReply) as caught:
                unit.write_single_register(0, 1)
            assert caught.value.code == 6


def test_sighup_replaces_the_policy_names_what_waits_for_the_next_start_and_refuses_a_wrong_formula(
    file: Path,
) -> None:
    text = FILE.replace("[simulation]", '[policy]\ndefault = "read-only"\n\n[simulation]')
    file.write_text(text)
    with Busway("simulate", str(file), "--speed", "1000", "--control", "off") as program:
        assert program.process.stdout is not None
        url = program.process.stdout.readline().decode().strip()
        with busway.connect(url, shared=False, retries=0) as link:
            unit = link.unit(3)
            with pytest.raises(busway.ExceptionReply):
                unit.write("4x1", 1.0, "float32")
            file.write_text(text.replace("read-only", "allow") + '[[fault]]\nfault_profile = "busy"\n')
            program.process.send_signal(signal.SIGHUP)
            assert program.wait_for("read again").endswith(
                "the policy was replaced; only the next start will see fault"
            )
            unit.write("4x1", 1.0, "float32")  # on the same connection, and nothing is busy
            file.write_text(text.replace("rate = 1", 'rate = "gone"'))
            program.process.send_signal(signal.SIGHUP)
            program.wait_for("nothing was changed")
            assert "there is no point 'gone'" in program.wait_for("behaviour.rate")
            unit.write("4x1", 2.0, "float32")
            first = unit.read("3x1", "uint32")
            deadline = time.monotonic() + 20
            while unit.read("3x1", "uint32") == first:
                assert time.monotonic() < deadline


def test_it_ends_by_itself_after_the_time_it_is_given(file: Path) -> None:
    with simulating(str(file), "--for", "50ms") as (process, (endpoint,)):
        assert endpoint.startswith("tcp://127.0.0.1:")
        assert process.wait(timeout=20) == 0


def test_the_seed_decides_what_chance_gives(file: Path) -> None:
    values = []
    for seed in ("1", "1", "2"):
        (file.parent / "state.json").unlink(missing_ok=True)
        with simulating(str(file), "--seed", seed) as (_, (endpoint,)), busway.connect(endpoint) as link:
            values.append(link.unit(3).read("3x3", "float32"))
    assert values[0] == values[1] != values[2]


def test_check_says_what_the_file_comes_to_and_serves_nothing(run: Callable[..., Any], file: Path) -> None:
    result = run("simulate", str(file), "--check")
    assert (result.code, result.out, result.err) == (0, "unit 3: tank: 3 points, 2 with a behaviour\n", "")


def test_check_opens_the_certificates_and_names_what_is_odd(run: Callable[..., Any], file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    file.write_text(text + '[security]\ncertificate = "none.pem"\n', encoding="utf-8")
    for command in (("simulate", str(file), "--check"), ("config", "check", str(file))):
        result = run(*command)
        assert (result.code, result.out) == (2, "")
        assert "security.certificate: " in result.err
    file.write_text(text + '[policy]\ndefault = "deny"\n[[policy.rule]]\nroles = ["Operator"]\n', encoding="utf-8")
    assert "no client can have a role" in run("simulate", str(file), "--check").err


def test_check_touches_no_kept_values(run: Callable[..., Any], file: Path) -> None:
    (file.parent / "state.json").write_text("{")
    assert run("simulate", str(file), "--check").code == 0
    assert [each.name for each in file.parent.iterdir() if "state" in each.name] == ["state.json"]


def test_a_bad_file_is_refused_with_file_and_line(run: Callable[..., Any], file: Path) -> None:
    file.write_text(FILE.replace("rate = 1", 'rate = "x + 1"'))
    result = run("simulate", str(file))
    assert result.code == 2
    assert result.out == ""
    assert result.err.startswith(f"{file}:20: unit[0].point[1].behaviour.rate: there is no point 'x'")


@pytest.mark.parametrize(
    ("option", "value"), [("--speed", "0"), ("--speed", "fast"), ("--seed", "-1"), ("--seed", "x"), ("--for", "0")]
)
def test_an_option_that_cannot_be_is_refused_by_its_name(
    run: Callable[..., Any], file: Path, option: str, value: str
) -> None:
    result = run("simulate", str(file), f"{option}={value}")
    assert result.code == 2
    assert option in result.err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--api", "nonsense"], "--api: an address such as 127.0.0.1:8502 is needed, not 'nonsense'"),
        (["--api-token", "token"], "--api-token: goes with --api only"),
    ],
)
def test_a_control_page_that_cannot_be_is_refused_by_its_option(
    run: Callable[..., Any], file: Path, words: list[str], sentence: str
) -> None:
    result = run("simulate", str(file), *words)
    assert (result.code, result.err) == (2, f"busway: {sentence}\n")


def test_a_state_that_cannot_be_read_is_said(file: Path) -> None:
    (file.parent / "state.json").write_text('{"kind": "busway simulation state"')
    with simulating(str(file), "--for", "10ms") as (process, _):
        _, said = process.communicate(timeout=60)
    assert "begins anew" in said
    assert process.returncode == 0


def test_the_schema_of_simulation_files_can_be_had(run: Callable[..., Any]) -> None:
    result = run("config", "schema", "--simulation")
    assert result.code == 0
    assert "random-walk" in json.dumps(json.loads(result.out))

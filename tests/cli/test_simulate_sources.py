"""`busway simulate` with ready-made devices, register maps and clones: what is read, written and said."""

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import busway
from busway.config.profiles import DEVICES

PROGRAM = [sys.executable, "-m", "busway", "simulate"]
MAP = "name;address;type;scale;value\nlevel;4x1;float32;;2,5\ntemperature;3x1;int16;0,1;-4,5\npump;0x1;;;on\n"


@pytest.fixture
def points(tmp_path: Path) -> Path:
    """A register map."""
    path = tmp_path / "points.csv"
    path.write_text(MAP, encoding="utf-8")
    return path


@pytest.fixture
def tank() -> Iterator[str]:
    """Where a device is served that fits the map."""
    device = busway.Device(holding_registers=2, input_registers=1, coils=1, identification={0: "Acme"})
    device.write("4x1", 7.25, "float32")
    device.write("3x1", 183, "int16")
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device}) as server:
        yield server.endpoints[0]


@contextmanager
def simulating(*arguments: str) -> Iterator[str]:
    """The endpoint of a running simulation."""
    words = [*PROGRAM, *arguments, "--listen", "tcp://127.0.0.1:0"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        endpoint = process.stdout.readline().strip()
        assert endpoint.startswith("tcp://"), process.communicate(timeout=60)[1]
        yield endpoint
    finally:
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=60)
    assert "Traceback" not in errors
    assert process.returncode == 0, errors


def test_the_ready_made_devices_are_listed(run: Callable[..., Any]) -> None:
    result = run("simulate", "--list-devices")
    assert result.code == 0
    assert [line.split()[0] for line in result.out.splitlines()] == list(DEVICES)


def test_a_ready_made_device_is_served() -> None:
    with simulating("--device", "meter") as endpoint, busway.connect(endpoint) as link:
        assert 200 < link.unit(1).read("3x1", "float32") < 260


@pytest.mark.parametrize("name", DEVICES)
def test_every_ready_made_device_passes_its_check(name: str, run: Callable[..., Any]) -> None:
    result = run("simulate", "--device", name, "--check")
    assert result.code == 0
    assert result.out.startswith(f"unit 1: {name}: ")


def test_a_register_map_is_served_as_it_stands(points: Path) -> None:
    with simulating("--map", str(points), "--unit", "5") as endpoint, busway.connect(endpoint) as link:
        unit = link.unit(5)
        assert (unit.read("4x1", "float32"), unit.read("3x1", "int16"), unit.read("0x1")) == (2.5, -45, True)


def test_a_clone_by_a_map_goes_to_stdout_and_serves_what_the_device_does(
    tank: str, points: Path, tmp_path: Path, run: Callable[..., Any]
) -> None:
    result = run("simulate", "--clone", tank, "--map", str(points))
    assert result.code == 0
    assert "busway: 3 points" in result.err
    file = tmp_path / "tank.toml"
    file.write_text(result.out, encoding="utf-8")
    assert 'vendor_name = "Acme"' in result.out
    with simulating(str(file)) as endpoint, busway.connect(endpoint) as link:
        unit = link.unit(1)
        assert (unit.read("4x1", "float32"), unit.read("3x1", "int16"), unit.read("0x1")) == (7.25, 183, False)


def test_a_clone_without_a_map_finds_what_there_is(tank: str, tmp_path: Path, run: Callable[..., Any]) -> None:
    file = tmp_path / "tank.toml"
    result = run("simulate", "--clone", tank, "--range", "0-49,100", "--out", str(file))
    assert result.code == 0
    assert result.out == ""
    assert f"{file} is written" in result.err
    assert "2 holding registers" in result.err
    again = run("simulate", str(file), "--check")
    assert again.code == 0
    with simulating(str(file)) as endpoint, busway.connect(endpoint) as link:
        assert link.unit(1).read_holding_registers(0, count=2) == [0x40E8, 0]


def test_a_file_that_is_there_is_not_overwritten_without_force(
    tank: str, closed_port: str, points: Path, tmp_path: Path, run: Callable[..., Any]
) -> None:
    file = tmp_path / "tank.toml"
    file.write_text("# mine", encoding="utf-8")
    # No device is asked: that would end with 5.
    result = run("simulate", "--clone", closed_port, "--map", str(points), "--out", str(file))
    assert (result.code, result.err) == (2, f"{file}: is there already; --force writes over it\n")
    assert file.read_text(encoding="utf-8") == "# mine"
    assert run("simulate", "--clone", tank, "--map", str(points), "--out", str(file), "--force").code == 0
    assert "[[unit]]" in file.read_text(encoding="utf-8")


def test_a_file_that_comes_while_the_device_is_asked_is_not_overwritten(
    tank: str, points: Path, tmp_path: Path, run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "tank.toml"
    file.write_text("# mine", encoding="utf-8")
    monkeypatch.setattr("os.path.lexists", lambda path: False)
    result = run("simulate", "--clone", tank, "--map", str(points), "--out", str(file))
    assert result.code == 2
    assert "is there already; --force writes over it" in result.err
    assert file.read_text(encoding="utf-8") == "# mine"


def test_a_point_that_the_device_has_not_is_said_and_left_out(tank: str, points: Path, run: Callable[..., Any]) -> None:
    points.write_text(MAP + "gone;4x100;;;\n", encoding="utf-8")
    result = run("simulate", "--clone", tank, "--map", str(points))
    assert result.code == 0
    assert "left out: point gone at 4x100: the device answered with exception 02" in result.err
    assert "# left out: point gone at 4x100" in result.out
    assert 'name = "gone"' not in result.out


def test_a_device_that_is_not_there_ends_with_the_code_for_it(
    closed_port: str, points: Path, run: Callable[..., Any]
) -> None:
    result = run("simulate", "--clone", closed_port, "--map", str(points))
    assert result.code == 5
    assert result.out == ""


def test_a_file_that_cannot_be_written_is_said(tank: str, points: Path, run: Callable[..., Any]) -> None:
    result = run("simulate", "--clone", tank, "--map", str(points), "--out", "/nowhere/plant.toml")
    assert result.code == 2
    assert "/nowhere/plant.toml: cannot be written: no such file or directory" in result.err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "FILE: one of FILE, --device and --map is needed"),
        (["plant.toml", "--device", "meter"], "--device: one of FILE, --device and --map is needed"),
        (["--device", "toaster"], "--device toaster: there is no such device, but meter"),
        (["--device", "meter", "--force"], "--force: goes with --clone only"),
        (["--clone", "tcp://127.0.0.1:1", "--force"], "--force: goes with --out only"),
        (["--device", "meter", "--unit", "3"], "--unit: does not go with --device"),
        (["--map", "gone.csv"], "gone.csv: cannot be read: no such file"),
        (["--device", "meter", "--out", "x"], "--out: goes with --clone only"),
        (["--device", "meter", "--thorough"], "--thorough: goes with --clone only"),
        (["--clone", "tcp://127.0.0.1:1", "--device", "meter"], "--clone: names what is recorded"),
        (["--clone", "tcp://127.0.0.1:1", "--watch", "1s"], "--watch: needs --map"),
        (["--clone", "tcp://127.0.0.1:1", "--range", "9-1"], "--range: offsets 0…65535 such as"),
        (["--clone", "tcp://127.0.0.1:1", "--map", "x.csv", "--range", "1-9"], "--range: does not go with --map"),
        (["--clone", "tcp://127.0.0.1:1", "--unit", "300"], "--unit: a whole number 0…255 is needed"),
        (["--clone", "nonsense"], "nonsense"),
    ],
)
def test_what_does_not_go_together_is_refused_by_its_name(
    arguments: Sequence[str], said: str, run: Callable[..., Any]
) -> None:
    result = run("simulate", *arguments)
    assert result.code == 2
    assert said in result.err


def test_a_bad_map_is_refused_with_line_and_column(points: Path, run: Callable[..., Any]) -> None:
    points.write_text("name,address\na,4x1\nb,nowhere\n", encoding="utf-8")
    for arguments in (["--map", str(points)], ["--clone", "tcp://127.0.0.1:1", "--map", str(points)]):
        result = run("simulate", *arguments)
        assert result.code == 2
        assert f"{points}:3: address: 'nowhere' is no address" in result.err


def test_a_file_that_does_not_say_its_unit_is_simulated_as_the_one_of_the_command_line(
    tmp_path: Path, run: Callable[..., Any]
) -> None:
    file = tmp_path / "tank.toml"
    file.write_text('[[unit]]\nname = "tank ${unit}"\npoint = [{ name = "level", address = "4x1" }]\n')
    result = run("simulate", str(file), "--check", "-u", "7")
    assert (result.code, result.out) == (0, "unit 7: tank 7: 1 point, 0 with a behaviour\n")
    file.write_text('[[unit]]\npoint = [{ name = "level", address = "4x1" }]\n')
    without = run("simulate", str(file), "--check")
    assert (without.code, without.out) == (2, "")
    assert "unit[0].unit: is missing; or say it by --unit" in without.err
    file.write_text('[[unit]]\nunit = [3, 4]\npoint = [{ name = "level", address = "4x1" }]\n')
    other = run("simulate", str(file), "--check", "-u", "7")
    assert (other.code, other.err) == (2, f"busway: --unit: {file} has the units 3, 4, not 7\n")

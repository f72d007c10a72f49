"""The pytest plugin, as the tests of a user do: by `pytester`, which runs them; and the page that documents it."""

import re
import socket
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

import busway
from busway.errors import ConfigError, ExceptionReply, InvalidRequest, LinkDown, NoReply
from busway.faults.clock import FakeClock
from busway.testing import simulated_device

pytest_plugins = ["pytester"]

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "how-to" / "test-your-own-code.md"
IS_INSTALLED = bool(entry_points(group="pytest11", name="busway"))
"""Whether pytest finds the plugin by itself; named a second time it would be refused."""
BY_NAME = () if IS_INSTALLED else ("-p", "busway.testing.plugin")
WITH_PLUGIN = (*BY_NAME, "-p", "no:asyncio", "-p", "no:cacheprovider", "-W", "error")


def files_of_the_page() -> dict[str, str]:
    """The blocks of the page that begin with the name of their file."""
    text = PAGE.read_text(encoding="utf-8")
    return dict(re.findall(r"^```py\n# (\S+)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE))


def test_the_tests_of_the_page_pass_as_they_stand_there(pytester: pytest.Pytester) -> None:
    blocks = files_of_the_page()
    assert list(blocks) == ["boiler.py", "test_boiler.py", "test_meter.py", "test_line.py"]
    for name, text in blocks.items():
        (pytester.path / name).write_text(text, encoding="utf-8")
    result = pytester.runpytest_subprocess(*WITH_PLUGIN)
    result.assert_outcomes(passed=11)


def test_a_test_of_the_page_fails_where_the_code_under_test_is_wrong(pytester: pytest.Pytester) -> None:
    blocks = files_of_the_page()
    wrong = blocks["boiler.py"].replace("temperature < setpoint", "temperature > setpoint")
    (pytester.path / "boiler.py").write_text(wrong, encoding="utf-8")
    (pytester.path / "test_boiler.py").write_text(blocks["test_boiler.py"], encoding="utf-8")
    result = pytester.runpytest_subprocess(*WITH_PLUGIN, "-k", "burner")
    result.assert_outcomes(failed=2)


def test_a_device_ends_with_its_test_also_where_that_fails(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import threading

        endpoints = []

        def test_that_fails(simulator):
            endpoints.append(simulator({"4x1": 1}).endpoint)
            raise RuntimeError

        def test_afterwards():
            import busway, pytest
            assert not [each for each in threading.enumerate() if each.name == "busway device"]
            with busway.connect(endpoints[0]) as link, pytest.raises(busway.LinkDown):
                link.unit(1).read("4x1")
        """
    )
    pytester.runpytest_subprocess(*WITH_PLUGIN).assert_outcomes(failed=1, passed=1)


def test_coroutines_talk_to_the_device_as_programs_with_threads_do(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import asyncio
        import busway

        async def read(url):
            async with busway.open(url) as link:
                return await link.unit(1).read("4x1")

        def test_read(simulator):
            assert asyncio.run(read(simulator({"4x1": 42}).endpoint)) == 42
        """
    )
    pytester.runpytest_subprocess(*WITH_PLUGIN).assert_outcomes(passed=1)


def test_a_run_that_asks_for_no_fixture_imports_nothing_of_the_simulator() -> None:
    program = (
        "import sys, pytest\n"
        "before = set(sys.modules)\n"
        "import busway.testing.plugin\n"
        "print(*sorted(name for name in set(sys.modules) - before if name != 'busway'))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    ours = [name for name in done.stdout.split() if name.startswith("busway")]
    assert set(ours) <= {"busway.version", "busway.interpreter", "busway.testing", "busway.testing.plugin"}
    assert not {"asyncio", "pydantic", "socket"} & set(done.stdout.split())


@pytest.mark.parametrize(
    ("address", "value", "kind", "read"),
    [
        ("4x1", 42, "uint16", 42),
        ("4x1", -3, "int16", -3),
        ("holding:0x10", 21.5, "float32", 21.5),
        ("3x5", (21.5, "float32", "CDAB"), None, None),
        ("4x1", (70_000, "uint32"), "uint32", 70_000),
        ("4x1", "Zähler", "string:7:utf-8", "Zähler"),
        ("0x1", True, None, True),
        ("1x9", False, None, False),
        ("4x1.3", True, None, True),
    ],
)
def test_a_value_is_served_in_the_type_that_fits_it(
    address: str, value: object, kind: str | None, read: object
) -> None:
    with simulated_device({address: value}) as device, busway.connect(device.endpoint) as link:
        if isinstance(value, tuple) and len(value) == 3:
            assert link.unit(1).read(address, value[1], order=value[2]) == value[0]
        else:
            assert link.unit(1).read(address, kind) == read


def test_a_list_goes_on_from_its_address_whatever_its_values_are() -> None:
    with simulated_device({"4x10": [1, 1, (2.5, "float32"), 4], "0x1": [True, True, False]}) as device:
        with busway.connect(device.endpoint) as link:
            assert link.unit(1).read("4x10", count=2) == [1, 1]
            assert link.unit(1).read("4x12", "float32") == 2.5
            assert link.unit(1).read("4x14") == 4
            assert link.unit(1).read("0x1", count=3) == [True, True, False]
        assert device["4x12"] == 2.5
        assert device["4x14"] == 4


def test_sixteen_bits_are_one_value() -> None:
    bits = [number % 3 == 0 for number in range(16)]
    with simulated_device({"4x1": (bits, "bits"), "4x2": 7}) as device, busway.connect(device.endpoint) as link:
        assert list(link.unit(1).read("4x1", "bits")) == bits
        device["4x1"] = [not bit for bit in bits]
        assert list(link.unit(1).read("4x1", "bits")) == [not bit for bit in bits]
        assert link.unit(1).read("4x2") == 7


def test_only_what_was_given_exists() -> None:
    with simulated_device({"4x1": 42}) as device, busway.connect(device.endpoint) as link:
        with pytest.raises(ExceptionReply) as caught:
            link.unit(1).read("4x2")
        assert caught.value.code == 2


def test_without_a_unit_any_is_answered_and_with_one_only_that() -> None:
    with simulated_device({"4x1": 42}) as device, busway.connect(device.endpoint) as link:
        assert [link.unit(unit).read("4x1") for unit in (0, 1, 77, 255)] == [42] * 4
    with simulated_device({"4x1": 42}, unit=7) as device, busway.connect(device.endpoint) as link:
        assert link.unit(7).read("4x1") == 42
        with pytest.raises(ExceptionReply):
            link.unit(8).read("4x1")


def test_values_are_read_and_set_by_any_notation_of_their_address() -> None:
    with simulated_device({"4x1": 42, "0x3": False}) as device, busway.connect(device.endpoint) as link:
        assert device["holding:0"] == device["40001"] == device["%MW0"] == 42
        device["40001"] = 43
        device["coil:2"] = True
        assert link.unit(1).read("4x1") == 43
        assert link.unit(1).read("0x3") is True
        with pytest.raises(InvalidRequest):
            device["4x99"]
        with pytest.raises(InvalidRequest):
            device["4x1"] = "many"


def test_a_file_gives_points_by_name_and_several_units_by_number(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(
        "[[unit]]\nunit = [1, 2]\n[[unit.point]]\nname = 'tank.level'\naddress = '4x1'\ntype = 'float32'\nvalue = 2.5\n"
        "[[unit]]\nunit = 3\n[[unit.point]]\nname = 'pump'\naddress = '0x1'\n",
        encoding="utf-8",
    )
    with simulated_device(file) as device, busway.connect(device.endpoint) as link:
        link.unit(2).write("4x1", 7.5, "float32")
        assert (device["1/tank.level"], device["2/tank.level"], device["pump"]) == (2.5, 7.5, False)
        with pytest.raises(InvalidRequest, match=r"several units have 'tank\.level'; name one, '1/tank\.level' or"):
            device["tank.level"]
    with pytest.raises(ConfigError, match="unit: stands in the file"), simulated_device(file, unit=4):
        pass


def test_a_register_map_is_a_device_too(tmp_path: Path) -> None:
    file = tmp_path / "map.csv"
    file.write_text("name;address;scale;value\nlevel;3x1;0,1;12,5\n", encoding="utf-8")
    with simulated_device(file) as device, busway.connect(device.endpoint) as link:
        assert device["level"] == 12.5
        assert link.unit(1).read("3x1") == 125


def test_reads_and_writes_of_clients_are_kept_in_order_and_those_of_the_test_are_not() -> None:
    with simulated_device({"4x1": [1, 2, 3]}) as device, busway.connect(device.endpoint) as link:
        device["4x1"] = 9
        link.unit(1).read("4x1", count=3)
        link.unit(1).write("4x2", [7, 8])
        link.unit(1).write("4x1", 5)
        assert [(each.address, each.values) for each in device.reads] == [(0, [9, 2, 3])]
        assert [(each.function, each.address, each.old, each.new) for each in device.writes] == [
            (16, 1, [2, 3], [7, 8]),
            (6, 0, [9], [5]),
        ]


def test_a_write_can_be_waited_for() -> None:
    import threading

    with simulated_device({"4x1": [0, 0]}) as device, busway.connect(device.endpoint) as link:
        is_seen = threading.Event()

        def write() -> None:
            while not is_seen.is_set():  # what is written before the wait begins does not count
                link.unit(1).write("4x1", 1)
                link.unit(1).write("4x2", 2)

        writer = threading.Thread(target=write)
        writer.start()
        try:
            assert device.wait_for_write("4x2") == 2
        finally:
            is_seen.set()
            writer.join()
        with pytest.raises(TimeoutError, match="no client wrote 4x1 within"):
            device.wait_for_write("4x1", timeout=0.01)


def test_a_fault_is_on_within_its_block_and_strikes_what_it_was_chosen_for() -> None:
    with simulated_device({"4x1": 42, "4x9": 43}) as device, busway.connect(device.endpoint, retries=0) as link:
        unit = link.unit(1)
        with device.fault("busy", addresses=["4x9"]) as fault:
            assert unit.read("4x1") == 42
            with pytest.raises(ExceptionReply) as caught:
                unit.read("4x9")
            fault.off()
            assert unit.read("4x9") == 43
        assert caught.value.code == 6
        assert fault.struck == 1
        assert unit.read("4x9") == 43
        assert device.simulation.switchboard.list() == []
        with device.fault("busy", addresses=range(8, 9), skip=1, times=1):
            assert unit.read("4x9") == 43
            with pytest.raises(ExceptionReply):
                unit.read("4x9")
            assert unit.read("4x9") == 43
        with pytest.raises(ConfigError, match="there is no fault profile 'tired'"), device.fault("tired"):
            pass
        with pytest.raises(ConfigError, match="delay"), device.fault("late", delay="long"):
            pass


def test_a_fault_is_for_one_unit_and_one_function_or_for_several(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text('[[unit]]\nunit = [1, 2]\n[[unit.point]]\nname = "a"\naddress = "4x1"\n')
    with simulated_device(file) as device, busway.connect(device.endpoint) as link:
        with device.fault("busy", units=1, functions=3) as one, pytest.raises(ExceptionReply, match="06"):
            link.unit(1).read("4x1")
        with device.fault("busy", units={1, 2}, functions=[4, 6]) as several:
            assert link.unit(1).read("4x1") == 0
            with pytest.raises(ExceptionReply, match="06"):
                link.unit(2).write("4x1", 1)
        with pytest.raises(ConfigError, match="units"), device.fault("busy", units="1-2"):
            pass
    assert (one.struck, several.struck) == (1, 1)


def test_values_that_a_file_keeps_are_not_carried_from_test_to_test(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(
        '[simulation]\nkeep = "state.json"\n[[unit]]\nunit = 1\n[[unit.point]]\nname = "a"\naddress = "4x1"\n'
    )
    for _ in range(2):
        with simulated_device(file) as device:
            assert device["a"] == 0
            device["a"] = 5
    assert [each.name for each in tmp_path.iterdir()] == ["plant.toml"]


def test_a_fault_ends_with_its_block_also_where_that_fails() -> None:
    with simulated_device({"4x1": 42}) as device:
        with pytest.raises(RuntimeError), device.fault("busy"):
            raise RuntimeError
        assert device.simulation.switchboard.list() == []


def test_delays_of_faults_and_behaviours_follow_a_clock_that_is_moved_by_hand() -> None:
    clock = FakeClock()
    with simulated_device("device:io", clock=clock) as device, busway.connect(device.endpoint, timeout=5) as link:
        assert device["uptime"] == 0
        clock.advance(600.0)
        assert device["uptime"] == 600
        assert link.unit(1).read("3x13", "uint32") == 600
    with (
        simulated_device({"4x1": 42}, clock=FakeClock()) as device,
        busway.connect(device.endpoint, timeout=0.05, retries=0) as link,
        device.fault("late", delay=0.001),
        pytest.raises(NoReply),
    ):
        link.unit(1).read("4x1")


def test_host_and_port_are_there_for_programs_that_take_no_url() -> None:
    with (
        simulated_device({"4x1": 42}) as device,
        socket.create_connection((device.host, device.port), timeout=60) as client,
    ):
        client.sendall(bytes.fromhex("0001 0000 0006 01 03 0000 0001"))
        assert client.recv(100) == bytes.fromhex("0001 0000 0005 01 03 02 002A")


def test_a_device_listens_where_the_url_says() -> None:
    with simulated_device({"4x1": 42}, url="udp://127.0.0.1:0") as device:
        assert device.endpoint.startswith("udp://127.0.0.1:")
        with busway.connect(device.endpoint) as link:
            assert link.unit(1).read("4x1") == 42


def test_a_place_that_cannot_be_listened_on_is_an_error_of_the_call() -> None:
    with (
        simulated_device({"4x1": 42}) as device,
        pytest.raises(LinkDown),
        simulated_device({"4x1": 1}, url=device.endpoint),
    ):
        pass


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({}, "needs a value at least"),
        ({"100": 1}, "does not say which table"),
        ({"4x1": [1, 70_000]}, "4x2: 70000 does not fit uint16"),
        ({"4x1": (1, "colour")}, "4x1: unknown type"),
        ({"4x1": None}, "4x1: a value is a number, a text, a bool"),
        ({"4x1": 2.5, "4x2": 1}, "4x2: 4x2 is taken by '4x1'"),
        ("device:toaster", "there is no such device, but meter"),
        ("gone.toml", "gone.toml: cannot be read"),
    ],
)
def test_what_cannot_be_served_is_refused_with_a_sentence(content: object, said: str) -> None:
    with pytest.raises((ConfigError, InvalidRequest), match=re.escape(said)), simulated_device(content):  # type: ignore[arg-type]
        pass

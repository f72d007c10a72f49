"""What works with nothing installed beside busway, and what the rest says that needs more.

Each program runs in a process of its own, in which the optional packages cannot be found.
"""

import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from waiting import wait_until

import busway
from busway.errors import ConfigError, MissingExtra
from busway.extras import EXTRA_OF, missing_extra

ROOT = Path(__file__).parents[1]
BARE = """
import sys

class Hide:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in HIDDEN:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

HIDDEN = set(sys.argv.pop(1).split(","))
sys.meta_path.insert(0, Hide())
import busway
"""

BROUGHT = "pydantic_core,click,uvloop"
"""What optional packages bring, or what is used where it is there."""

ROUND_TRIP = """
with busway.serve_in_thread(sys.argv[1], units={1: busway.Device(holding_registers=10)}) as server:
    url = server.endpoints[0]
    with busway.connect(url) as link:
        link.unit(1).write_single_register(3, 7)
        print(link.unit(1).read("4x4"))

    async def main():
        async with busway.open(url) as link:
            print(await link.unit(1).read("4x4"))

    import asyncio
    asyncio.run(main())
"""


def bare(program: str, *arguments: str, hidden: str = ",".join(EXTRA_OF)) -> subprocess.CompletedProcess[str]:
    """What a program ends with where the ``hidden`` packages are not installed."""
    return subprocess.run(
        [sys.executable, "-c", BARE + program, f"{BROUGHT},{hidden}", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize("scheme", ["tcp", "udp", "rtu+tcp", "ascii+tcp"])
def test_client_and_server_need_nothing_but_python(scheme: str) -> None:
    ended = bare(ROUND_TRIP, f"{scheme}://127.0.0.1:0")
    assert ended.stdout == "7\n7\n", ended.stderr


@pytest.mark.parametrize(
    ("use", "sentence"),
    [
        (
            "busway.connect('rtu:///dev/ttyUSB0')",
            "a serial port needs the package serialx: pip install 'busway[serial]'",
        ),
        (
            "busway.serve_in_thread('ascii:///dev/ttyUSB0', units=busway.Device()).__enter__()",
            "a serial port needs the package serialx: pip install 'busway[serial]'",
        ),
        (
            "busway.load_configuration('x.toml')",
            "a configuration needs the package pydantic: pip install 'busway[files]'",
        ),
        ("busway.load_gateway('x.toml')", "a configuration needs the package pydantic: pip install 'busway[files]'"),
    ],
)
def test_what_needs_more_names_the_command_that_installs_it(use: str, sentence: str) -> None:
    ended = bare(f"try:\n    {use}\nexcept (busway.ConfigError, ImportError) as error:\n    print(error)\n")
    assert ended.stdout == sentence + "\n", ended.stderr


COMMAND = "from busway.cli import main\nsys.argv[0] = 'busway'\nmain()\n"


@pytest.mark.parametrize("arguments", [[], ["--help"], ["read", "tcp://127.0.0.1", "4x1"]])
def test_the_command_without_its_extra_is_one_sentence_and_code_2(arguments: list[str]) -> None:
    ended = bare(COMMAND, *arguments)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr == "busway: this command needs the package typer: pip install 'busway[cli]'\n"


@pytest.mark.parametrize(
    ("hidden", "arguments", "extra"),
    [
        ("rich", ["read", "tcp://127.0.0.1:1", "4x1", "--timeout", "0.1s"], ""),
        ("pydantic", ["config", "check", "x.toml"], "files"),
        ("pydantic", ["serve", "x.toml"], "files"),
        ("serialx", ["read", "rtu:///dev/nowhere", "4x1", "-u", "1"], "serial"),
    ],
)
def test_a_command_names_what_only_it_needs(hidden: str, arguments: list[str], extra: str) -> None:
    ended = bare(COMMAND, *arguments, hidden=hidden)
    (sentence,) = ended.stderr.splitlines()
    assert sentence.startswith("busway: ")
    assert (f"pip install 'busway[{extra}]'" in sentence) == bool(extra)
    assert ended.returncode == (2 if extra else 5)


OF_FLEETS = ("nats", "nkeys", "msgpack", "asyncpg")
PLANT = """
[collector]
store = "data"
page = "127.0.0.1:0"
[poll_class]
all.period = 0.1
[[sink]]
name = "scrape"
url = "prometheus://127.0.0.1:0"
points = ["meter/*"]
[[link]]
name = "hall"
url = "{url}"
[[device]]
name = "meter"
link = "hall"
unit = 1
profile = "meter.toml"
"""
METER = """
[[unit]]
[[unit.point]]
name = "count"
address = "4x1"
type = "uint16"
"""
COLLECT = """
import atexit
atexit.register(lambda: print("loaded:", sorted(name for name in sys.modules if ".fleet" in name or name in HIDDEN)))
"""


def is_stored(folder: Path) -> bool:
    """Whether there is a store with samples; one that is being made cannot be read yet."""
    try:
        return len(busway.Store(folder).read("*/*")) > 0
    except ConfigError:
        return False


def test_a_collector_of_no_fleet_polls_and_opens_its_pages_without_the_packages_of_fleets(tmp_path: Path) -> None:
    (tmp_path / "meter.toml").write_text(METER)
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=10)}) as server:
        (tmp_path / "plant.toml").write_text(PLANT.replace("{url}", server.endpoints[0]))
        command = [sys.executable, "-c", BARE + COLLECT + COMMAND, ",".join(OF_FLEETS), "collect"]
        with subprocess.Popen([*command, str(tmp_path / "plant.toml")], stdout=subprocess.PIPE, text=True) as running:
            try:
                wait_until(lambda: is_stored(tmp_path / "data"))
                running.send_signal(signal.SIGINT)
                out, _ = running.communicate(timeout=60)
            finally:
                running.kill()
    assert running.returncode == 0
    assert "loaded: []" in out


def test_the_error_is_one_of_a_setting_and_one_of_an_import() -> None:
    error = missing_extra(ModuleNotFoundError(name="rich.table"))
    assert isinstance(error, ConfigError)
    assert isinstance(error, ImportError)
    assert (error.package, error.extra) == ("rich", "cli")
    assert missing_extra(ModuleNotFoundError(name="busway.lost")) is None
    assert missing_extra(ImportError()) is None
    for name in ("google", "google.protobuf", "google.protobuf.message"):
        error = missing_extra(ModuleNotFoundError(name=name))
        assert isinstance(error, MissingExtra)
        assert (error.package, error.extra) == ("google.protobuf", "sparkplug")
    for name in ("google.cloud", "richer", "googles"):
        assert missing_extra(ModuleNotFoundError(name=name)) is None
    assert str(MissingExtra("rich", "cli", purpose="a table")) == (
        "a table needs the package rich: pip install 'busway[cli]'"
    )


def test_every_extra_that_an_error_names_brings_the_package() -> None:
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8")
    project = tomllib.loads(text)["project"]
    assert project["dependencies"] == []
    for package, extra in EXTRA_OF.items():
        wanted = {"yaml": "PyYAML"}.get(package, package.removeprefix("google.").replace("_", "-"))
        assert any(line.startswith(wanted) for line in project["optional-dependencies"][extra]), package


def test_the_start_page_names_every_extra_that_is_for_users() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    install = (
        (ROOT / "docs" / "index.md").read_text(encoding="utf-8").partition("## Install\n")[2].partition("\n## ")[0]
    )
    for extra in project["optional-dependencies"].keys() - {"bench", "docs", "release", "dev", "all"}:
        assert f"`{extra}`" in install, extra

"""The reference says what the code says: defaults, errors, exception codes, endpoints, types, orders."""

import inspect
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from generated import assert_up_to_date

import busway
from busway import errors
from busway.cli.program import COMMANDS, load
from busway.codes import EXCEPTION_MEANING
from busway.options.endpoints import SCHEMES
from busway.values import ORDERS, TYPE_NAMES

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "docs" / "reference"


def test_every_page_has_a_place_in_the_navigation_of_the_site() -> None:
    listed = re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    pages = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    made = {one for one in listed if one.startswith(("project/", "reference/api/"))}
    assert set(listed) - made == pages
    assert len(listed) == len(set(listed))


def page(name: str) -> str:
    return (REFERENCE / name).read_text(encoding="utf-8")


@pytest.mark.clause("T19")
def test_the_defaults_are_those_of_the_parameter_classes_and_the_guides_keepalive_stands_beside_ours() -> None:
    assert_up_to_date("option_tables.py")
    text = page("defaults.md")
    assert "| idle time before the first probe | 2 hours | 60 s |" in text
    assert "| time between probes | 75 s | 10 s |" in text
    assert "| probes that may be lost | 8 | 3 |" in text


def test_every_error_is_listed() -> None:
    names = [name for name, one in inspect.getmembers(errors, inspect.isclass) if issubclass(one, errors.ModbusError)]
    assert len(names) > 5
    text = page("errors.md")
    assert [name for name in names if f"`{name}`" not in text and name != "ModbusError"] == []


def test_every_exception_code_is_listed_with_the_first_word_of_its_meaning() -> None:
    text = page("errors.md")
    for code, meaning in EXCEPTION_MEANING.items():
        assert f"| {code:02X} | {meaning.split()[0].rstrip(':')} " in text


def test_every_scheme_is_listed_with_its_port() -> None:
    text = page("endpoints.md")
    for name, scheme in SCHEMES.items():
        (row,) = [line for line in text.splitlines() if line.startswith(f"| `{name}://")]
        if scheme.default_port is not None:
            assert f"| {scheme.default_port} |" in row


def test_who_can_use_a_scheme_is_what_client_and_server_take() -> None:
    for name, scheme in SCHEMES.items():
        (row,) = [line for line in page("endpoints.md").splitlines() if line.startswith(f"| `{name}://")]
        where = f"/dev/not-there-{name}" if scheme.carrier == "serial" else "127.0.0.1:5020"
        users = [kind for kind, make in USERS.items() if takes(make, f"{name}://{where}")]
        assert row.endswith(f"| {' and '.join(users) or 'none yet'} |")


USERS = {
    "client": lambda url: busway.connect(url).close(),
    "server": lambda url: busway.serve(url, units={1: busway.Device()}),
}


def takes(make: Callable[[str], object], url: str) -> bool:
    try:
        make(url)
    except busway.ConfigError as error:
        return error.key in ("authority", "certificate")  # it asks for the files that it needs
    return True


def test_every_type_and_order_is_listed() -> None:
    text = page("values-and-addresses.md")
    assert [name for name in TYPE_NAMES if f"`{name}`" not in text] == []
    assert [order for orders in ORDERS.values() for order in orders if f"`{order}`" not in text] == []


SHARED = re.compile(r"^\| (`-.*?) \| (`.*?`) \| .* \|$", re.MULTILINE)
"""A row of the table of shared options: the option, the commands that take it, its meaning."""


def options_in(text: str) -> set[str]:
    """The long options that a text names."""
    return set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text))


def options_of(command: str) -> set[str]:
    """The long options that a command takes."""
    params = [param for param in load(command).params if param.param_type_name == "option"]
    given = {name for param in params for name in (*param.opts, *param.secondary_opts)}
    return {name for name in given if name.startswith("--")} - {"--help"}


def shared_options() -> dict[str, set[str]]:
    """The commands that take each shared option, as the page says."""
    text = page("cli.md").partition("\n## Options that several commands share\n")[2].partition("\n## ")[0]
    rows = {
        option: set(re.findall(r"`(\w+)`", of)) for names, of in SHARED.findall(text) for option in options_in(names)
    }
    assert len(rows) >= 8
    return rows


def section_of(text: str, command: str) -> str:
    return text.partition(f"\n## {command}\n")[2].partition("\n## ")[0]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_row_and_all_its_options_on_the_page(command: str) -> None:
    text = page("cli.md")
    assert re.search(rf"^\| `busway {command}\b", text, re.MULTILINE)
    section = section_of(text, command)
    above = section_of(text, "serve") if "printed as by `serve`, and the options" in section.replace("\n", " ") else ""
    shared = {option for option, commands in shared_options().items() if command in commands}
    assert shared <= options_of(command)
    assert options_of(command) - shared <= options_in(section + above)
    rows = "\n".join(re.findall(r"^\| (`-.*?) \| ", section, re.MULTILINE))
    assert options_in(rows) <= options_of(command)

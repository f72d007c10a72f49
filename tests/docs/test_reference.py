"""The reference says what the code says: defaults, errors, exception codes, endpoints, types, orders."""

import inspect
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from generated import assert_up_to_date

import busway
from busway import errors
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
        assert row.endswith(f"| {' and '.join(users) or 'nobody yet'} |")


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

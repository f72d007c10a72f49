"""The files that pages show can be read: collector files, parts of them, device files, and files of other programs.

Of a collector file that is whole, its links, classes and profiles are there too. Other tests read those of the
chapters on the simulator, the gateway and security.
"""

import re
import tomllib
from pathlib import Path

import pytest

from busway.apps.collector.configuration import parse_collector
from busway.apps.gateway.configuration import parse_gateway
from busway.apps.importers.telegraf import read_telegraf
from busway.apps.simulator.includes import parse_declaration
from busway.config.files.collector import CollectorFile
from busway.config.files.system import SystemFile
from busway.config.files.toml_source import read_source
from busway.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
REST = {
    "poll_class": "[poll_class]\nrest.period = 1.0\n",
    "link": '[[link]]\nname = "rest"\nurl = "tcp://127.0.0.1"\n',
    "device": '[[device]]\nname = "rest"\nlink = "rest"\nprofile = "meter"\n',
}
"""What a collector file must have, for parts of one that a page shows by themselves."""

WHOLE = "".join(REST.values())

OF_FLEETS = {"hosts", "gateway_wait"}
"""Keys of links that only collector files have."""


def blocks() -> list[tuple[str, str]]:
    pages = [page for folder in ("how-to", "reference", "tutorial") for page in (ROOT / "docs" / folder).rglob("*.md")]
    return [
        (f"{page.relative_to(ROOT / 'docs')}-{number}", block)
        for page in sorted(pages)
        for number, block in enumerate(re.findall(r"^```toml\n(.*?)^```$", page.read_text("utf-8"), re.S | re.M), 1)
    ]


def check(text: str) -> None:
    values = tomllib.loads(text)
    keys = values.keys()
    if "inputs" in keys:
        assert not read_telegraf(text, "page.toml").omissions
    elif {"link", "device"} <= keys:
        parse_collector(text, "page.toml")
    elif keys & {"collector", "page_access", "sink"} or any(OF_FLEETS & link.keys() for link in values.get("link", ())):
        rest = "" if "device" in keys else "".join(REST.values())
        read_source(f"{text}\n{rest}", "page.toml").checked(CollectorFile)
    elif "route" in keys:
        parse_gateway(text, "page.toml")
    elif keys & {"server", "policy", "security"}:
        read_source(text, "page.toml").checked(SystemFile)
    else:
        parse_declaration(text, "page.toml")


@pytest.mark.parametrize("text", [pytest.param(text, id=name) for name, text in blocks()])
def test_a_file_of_a_page_can_be_read(text: str) -> None:
    check(text)


@pytest.mark.parametrize(
    "text",
    [
        '[collector]\nstroe = "data"\n',
        '[page_access]\nkey = "page.key"\n',
        '[[sink]]\nname = "a"\nurl = "mqtt://broker"\nper_piont = true\n',
        '[[unit]]\npoint = [{ name = "a", address = "4y1" }]\n',
        WHOLE.replace('link = "rest"', 'link = "other"'),
        WHOLE.replace('profile = "meter"', 'profile = "metre"'),
        WHOLE + 'poll_class = "fast"\n',
    ],
)
def test_a_file_that_cannot_be_is_found(text: str) -> None:
    with pytest.raises(ConfigError):
        check(text)

"""The text of a device file, read again: it gives the same units."""

import pytest

from busway.apps.simulator.device_text import device_text
from busway.apps.simulator.includes import parse_declaration

FILE = """\
[[unit]]
unit = 1

[[unit.point]]
name = "pump.mode"
address = "4x1"
type = "uint16"
description = {name}
enumeration = {{ {name} = 0, auto = 1 }}
"""


@pytest.mark.parametrize(
    "name", ["off", "half speed", '"quoted"', "$speed", "${speed}", "\u200bhidden", "\x7f", "Größe"]
)
def test_names_and_descriptions_are_the_same_when_the_text_is_read_again(name: str) -> None:
    quoted = "'" + name + "'" if name.isprintable() else '"' + "".join(f"\\U{ord(each):08X}" for each in name) + '"'
    text = FILE.format(name=quoted)
    text = text.replace(f"description = {quoted}", f"description = {quoted.replace('${', '$${')}")
    (first,) = parse_declaration(text, "first.toml").units
    again = device_text([first.section])
    assert again.isascii() or name == "Größe", "what cannot be seen is escaped"
    (second,) = parse_declaration(again, "second.toml").units
    assert second.section == first.section
    assert second.section.point[0].enumeration == {name: 0, "auto": 1}
    assert second.section.point[0].description == name

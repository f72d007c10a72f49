"""Texts and keys in TOML, as any reader reads them."""

import tomllib

import pytest

from busway.config.toml_text import toml_key, toml_string


@pytest.mark.parametrize(
    "text", ["", "off", "half speed", 'a "b" \\ c', "a\nb\t\x00\x1f\x7f", "\u200b\U000e0001", "Größe", "${x}"]
)
def test_a_text_and_a_key_are_read_as_they_were(text: str) -> None:
    assert tomllib.loads(f"{toml_key(text)} = {toml_string(text)}") == {text: text}
    assert toml_string(text).isprintable()


def test_a_key_is_quoted_only_where_it_must_be() -> None:
    assert [toml_key(name) for name in ("unit", "max-age_2", "1", "a.b", "", "Größe")] == [
        "unit",
        "max-age_2",
        "1",
        '"a.b"',
        '""',
        '"Größe"',
    ]

"""Options as text and as values: each type both ways, and the key in every error."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pytest

from busway.client.settings import link_settings
from busway.errors import ConfigError
from busway.options.client import ClientParameters, MismatchPolicy
from busway.options.declaration import declared
from busway.options.server import Scope, ServerParameters
from busway.options.text import build_parameters, host_and_port


@dataclass(frozen=True)
class Names:
    """A type of its own, made of a list of texts."""

    all: tuple[str, ...] = ()

    @classmethod
    def parse(cls, texts: Sequence[str]) -> "Names":
        for text in texts:
            if not text.isalpha():
                raise ConfigError(f"{text!r} is no name")
        return cls(tuple(texts))


@dataclass(frozen=True)
class Everything:
    """A field of each type that parameters have."""

    whole: int = 1
    number: float = 1.0
    switch: bool = False
    text: str = "a"
    policy: MismatchPolicy = MismatchPolicy.STRICT
    perhaps: float | None = None
    names: Names = Names()
    either: float | Scope = Scope.SERVER


def test_the_options_of_a_class_are_its_fields_in_their_order() -> None:
    assert tuple(declared(Everything)) == ("whole", "number", "switch", "text", "policy", "perhaps", "names", "either")


@pytest.mark.parametrize(
    ("key", "given", "value"),
    [
        ("whole", 5, 5),
        ("whole", "5", 5),
        ("whole", "-5", -5),
        ("number", 2, 2.0),
        ("number", 2.5, 2.5),
        ("number", "2.5", 2.5),
        ("number", "1e-3", 0.001),
        ("switch", True, True),
        ("switch", "on", True),
        ("switch", "TRUE", True),
        ("switch", "1", True),
        ("switch", "no", False),
        ("switch", "off", False),
        ("text", "b", "b"),
        ("text", "5", "5"),
        ("policy", "automatic", MismatchPolicy.AUTOMATIC),
        ("policy", MismatchPolicy.IGNORE, MismatchPolicy.IGNORE),
        ("perhaps", None, None),
        ("perhaps", "none", None),
        ("either", "2.5", 2.5),
        ("either", 3, 3.0),
        ("either", "connection", Scope.CONNECTION),
        ("perhaps", "2", 2.0),
        ("names", "a, b", Names(("a", "b"))),
        ("names", ["a"], Names(("a",))),
        ("names", Names(("c",)), Names(("c",))),
        ("perhaps", 2, 2.0),
    ],
)
def test_a_value_or_its_text_becomes_the_type_of_the_field(key: str, given: object, value: object) -> None:
    built = getattr(build_parameters(Everything, {key: given}), key)
    assert built == value
    assert type(built) is type(value)


@pytest.mark.parametrize(
    ("key", "given", "sentence"),
    [
        ("whole", "five", "must be a whole number, not 'five'"),
        ("whole", "5.0", "must be a whole number, not '5.0'"),
        ("whole", 5.0, "must be a whole number, not 5.0"),
        ("whole", True, "must be a whole number, not True"),
        ("whole", None, "must be a whole number, not None"),
        ("number", "fast", "must be a number, not 'fast'"),
        ("number", True, "must be a number, not True"),
        ("switch", "maybe", "must be on or off, not 'maybe'"),
        ("switch", 1, "must be on or off, not 1"),
        ("text", 5, "must be a text, not 5"),
        ("policy", "lax", "must be one of strict, automatic, ignore, not 'lax'"),
        ("policy", 5, "must be one of strict, automatic, ignore, not 5"),
        ("whole", "none", "must be a whole number, not 'none'"),
        ("either", "all", "must be a number or connection or server, not 'all'"),
        ("names", 5, "must be a list of texts, not 5"),
        ("names", ["a", 5], "must be a list of texts, not ['a', 5]"),
        ("names", "a, !", "'!' is no name"),
        ("colour", "red", "unknown option; there are either, names, number, perhaps, policy, switch, text, whole"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_key(key: str, given: object, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        build_parameters(Everything, {key: given})
    assert str(caught.value) == f"{key}: {sentence}"
    assert caught.value.key == key


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("timeout=500ms", "timeout: is in seconds: timeout=0.5"),
        ("idle=1", "idle: unknown option"),
        ("hold=5m", "hold: is in seconds: hold=300"),
        ("retries=5s", "retries: must be a whole number, not '5s'"),
    ],
)
def test_a_duration_with_a_unit_is_refused_with_the_seconds_that_it_is(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        link_settings(f"tcp://h?{text}", {})
    assert str(caught.value).startswith(sentence)


@pytest.mark.clause("T33")
def test_the_parameters_of_conversations_are_built_and_checked_from_texts() -> None:
    texts: dict[str, Any] = {"timeout": "0.5", "max_transactions": "16", "deadline": "3", "single_adu_segments": "yes"}
    assert build_parameters(ClientParameters, texts) == ClientParameters(
        timeout=0.5, max_transactions=16, deadline=3.0, single_adu_segments=True
    )
    assert build_parameters(ServerParameters, {"scope": "server"}).scope is Scope.SERVER
    with pytest.raises(ConfigError, match="max_transactions: must be 1…16, not 17"):
        build_parameters(ClientParameters, {"max_transactions": "17"})


def test_every_option_left_out_has_its_default() -> None:
    assert build_parameters(ClientParameters, {}) == ClientParameters()


@pytest.mark.parametrize(
    ("text", "expected"),
    [("127.0.0.1:9502", ("127.0.0.1", 9502)), ("[::1]:0", ("::1", 0)), ("name:65535", ("name", 65535))],
)
def test_host_and_port_are_told_apart(text: str, expected: tuple[str, int]) -> None:
    assert host_and_port(text, "metrics") == expected


@pytest.mark.parametrize("text", ["", "127.0.0.1", ":9502", "::1:9502", "a:b", "a:-1", "a:٣", "1", "a:", "[]:1"])
def test_what_is_no_host_and_port_is_named(text: str) -> None:
    with pytest.raises(ConfigError, match=r"metrics: an address such as 127\.0\.0\.1:9502"):
        host_and_port(text, "metrics")


def test_a_port_that_cannot_be_is_named() -> None:
    with pytest.raises(ConfigError, match=r"listen: an address such as .* is needed; a port is 0…65535, not 65536"):
        host_and_port("a:65536", "listen")

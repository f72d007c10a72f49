"""Warnings about a configuration are logged when it is read, and again only after it had been without them."""

import logging
from dataclasses import dataclass

import pytest

from busway.apps.service.file_warnings import logging_warnings
from busway.errors import ConfigError


@dataclass(frozen=True)
class Odd:
    warnings: tuple[ConfigError, ...]


def odd(*words: str) -> Odd:
    return Odd(tuple(ConfigError(word, file="x.toml", line=3, key="link") for word in words))


def test_each_warning_is_one_line_and_is_not_repeated_while_it_stays(caplog: pytest.LogCaptureFixture) -> None:
    files = iter([odd("a", "b"), odd("a", "b", "c"), odd("b"), odd("a", "b")])
    read = logging_warnings(lambda: next(files))
    found = []
    for _ in range(4):
        caplog.clear()
        read()
        assert all((each.name, each.levelno) == ("busway.config", logging.WARNING) for each in caplog.records)
        found.append([each.getMessage() for each in caplog.records])
    assert found == [["x.toml:3: link: a", "x.toml:3: link: b"], ["x.toml:3: link: c"], [], ["x.toml:3: link: a"]]

"""The chapter about TLS names every option, every suite and every reason of a refusal."""

from dataclasses import fields
from pathlib import Path

import pytest

from busway.options.tls import NULL_SUITES, SUITES, TlsParameters
from busway.transport.tls.failures import FailureKind

PAGE = Path(__file__).parents[2] / "docs" / "security.md"
UNSEEN = {FailureKind.OTHER, FailureKind.WRONG_NAME}
"""Clients have no names, and the rest has no word."""


@pytest.mark.parametrize(
    "word",
    [
        *(field.name for field in fields(TlsParameters)),
        *SUITES,
        *NULL_SUITES,
        *(kind.value for kind in FailureKind if kind not in UNSEEN),
    ],
)
def test_the_chapter_names_it(word: str) -> None:
    chapter = PAGE.read_text(encoding="utf-8").partition("\n## TLS\n")[2]
    assert f"`{word}`" in chapter

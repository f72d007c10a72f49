"""The exit code of every error, and their documentation."""

from pathlib import Path

import pytest

from busway import (
    BadReply,
    ConfigError,
    ExceptionReply,
    InvalidRequest,
    LinkDown,
    ModbusError,
    NoReply,
    Overloaded,
    UnitSuspended,
    WriteOutcomeUnknown,
)
from busway.cli.exits import ExitCode, exit_code_of

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "cli.md"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (InvalidRequest("x"), 2),
        (ConfigError("x"), 2),
        (NoReply("x"), 3),
        (UnitSuspended("x", next_probe=1.0), 3),
        (WriteOutcomeUnknown("x"), 3),
        (Overloaded("x"), 3),
        (ExceptionReply(2), 4),
        (LinkDown("x"), 5),
        (BadReply("x"), 6),
    ],
)
def test_every_error_has_its_code(error: ModbusError, code: int) -> None:
    assert exit_code_of(error) == code


def test_the_reference_lists_every_code() -> None:
    rows = [
        line.split("|")[1].strip() for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")
    ]
    assert [str(int(code)) for code in ExitCode] == [row for row in rows if row.isdecimal()]

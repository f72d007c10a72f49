"""What type checkers say of uses of the public interface: right ones pass, and every wrong one is refused.

``right.py`` and ``wrong.py`` are read and never run. Each line of ``wrong.py`` with a comment ``# wrong`` must be
refused, and no other line.
"""

import json
import os
import re
import subprocess
import sys
from itertools import chain
from pathlib import Path
from typing import get_args

import pytest
from generated import assert_up_to_date
from type_checkers import errors_of_pyright, pyright

from busway.client.operations import LEVELS
from busway.codes import Table
from busway.errors import InvalidRequest
from busway.server.hooks import Moment, When
from busway.values import ORDERS, TYPE_NAMES, value_type
from busway.values.names import FloatName, IdentificationLevel, IntegerName, Order, TableName, WritableTableName
from busway.values.network import NETWORK_TYPES

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
RIGHT, WRONG = HERE / "right.py", HERE / "wrong.py"


def refused_by_mypy(file: Path) -> set[int]:
    """The lines that ``mypy --strict`` refuses."""
    words = [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", "--hide-error-context", str(file)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False, timeout=110)
    assert done.returncode in (0, 1), done.stdout + done.stderr
    found = {int(line) for line in re.findall(rf"{file.name}:(\d+): error", done.stdout)}
    assert found or not done.returncode, done.stdout
    return found


def refused_by_pyright(file: Path) -> set[int]:
    """The lines that pyright refuses."""
    return {one["range"]["start"]["line"] + 1 for one in errors_of_pyright([file], cwd=ROOT)}


CHECKERS = pytest.mark.parametrize("refused", [refused_by_mypy, refused_by_pyright], ids=["mypy", "pyright"])


@CHECKERS
def test_right_uses_are_accepted(refused: object) -> None:
    assert callable(refused)
    assert refused(RIGHT) == set()


@CHECKERS
def test_every_wrong_use_is_refused_and_nothing_else(refused: object) -> None:
    assert callable(refused)
    lines = WRONG.read_text("utf-8").splitlines()
    marked = {number for number, line in enumerate(lines, 1) if "# wrong: " in line}
    assert len(marked) >= 37
    assert refused(WRONG) == marked


def test_the_names_of_types_are_those_that_exist() -> None:
    names = {*get_args(IntegerName), *get_args(FloatName)}
    plain = {name for name in TYPE_NAMES if ":" not in name} - {"bits", *NETWORK_TYPES}
    assert {value_type(name).name for name in names} == plain
    for name in get_args(FloatName):
        assert isinstance(value_type(name).parse("1"), float)
    for name in get_args(IntegerName):
        assert isinstance(value_type(name).parse("1"), int)


def test_the_names_of_orders_and_levels_are_those_that_exist() -> None:
    letters = {name for name in get_args(Order) if name.isupper()}
    assert letters == {*chain.from_iterable(ORDERS.values())}
    for word in get_args(Order):
        name = "uint48" if word in ORDERS[48] else "uint64"
        assert value_type(name, word).registers == int(name[-2:]) // 16
    with pytest.raises(InvalidRequest, match="words big, little, word-swapped, byte-swapped"):
        value_type("uint64", "middle")
    assert get_args(IdentificationLevel) == (*LEVELS,)


def test_the_names_of_tables_and_moments_are_those_that_exist() -> None:
    assert set(get_args(TableName)) == {each.value for each in Table}
    assert set(get_args(WritableTableName)) == {each.value for each in Table if each.is_writable}
    assert set(get_args(Moment)) == {each.value for each in When}


def test_the_types_of_options_are_those_of_the_parameter_classes() -> None:
    assert_up_to_date("option_types.py")


def test_public_symbols_have_types_that_checkers_agree_on(tmp_path: Path) -> None:
    program = pyright()
    words = [program, "--verifytypes", "busway", "--ignoreexternal", "--outputjson", "--pythonpath", sys.executable]
    (tmp_path / "busway").symlink_to(ROOT / "src" / "busway")  # pyright finds no package that is installed editable
    done = subprocess.run(
        words,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
        timeout=110,
    )
    told = json.loads(done.stdout)["typeCompleteness"]
    unknown = [one["name"] for one in told["symbols"] if one["isExported"] and not one["isTypeKnown"]]
    assert told["completenessScore"] >= 0.99, unknown

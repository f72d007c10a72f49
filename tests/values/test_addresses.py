"""Address notations: every notation with its base, the traps, and that what is printed is read back."""

from typing import Literal

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from busway.codes import Table
from busway.errors import InvalidRequest
from busway.values import Address, format_address, parse_address
from busway.values.addresses import table_named

COILS = Table.COILS
DISCRETE = Table.DISCRETE_INPUTS
INPUT = Table.INPUT_REGISTERS
HOLDING = Table.HOLDING_REGISTERS


@pytest.mark.parametrize(
    ("text", "table", "offset"),
    [
        # table prefix and number, from 1
        ("0x1", COILS, 0),
        ("1x1", DISCRETE, 0),
        ("3x1", INPUT, 0),
        ("4x1", HOLDING, 0),
        ("4X00017", HOLDING, 16),
        ("4x65536", HOLDING, 65535),
        ("4x40001", HOLDING, 40000),
        # five digits, from 1
        ("00001", COILS, 0),
        ("09999", COILS, 9998),
        ("10001", DISCRETE, 0),
        ("19999", DISCRETE, 9998),
        ("30001", INPUT, 0),
        ("39999", INPUT, 9998),
        ("40001", HOLDING, 0),
        ("49999", HOLDING, 9998),
        # six digits, from 1
        ("000001", COILS, 0),
        ("065536", COILS, 65535),
        ("100001", DISCRETE, 0),
        ("165536", DISCRETE, 65535),
        ("300001", INPUT, 0),
        ("365536", INPUT, 65535),
        ("400001", HOLDING, 0),
        ("465536", HOLDING, 65535),
        # the table by name, from 0
        ("coil:3", COILS, 3),
        ("coils:3", COILS, 3),
        ("discrete:3", DISCRETE, 3),
        ("discrete_input:3", DISCRETE, 3),
        ("discrete_inputs:3", DISCRETE, 3),
        ("discrete-inputs:3", DISCRETE, 3),
        ("input:3", INPUT, 3),
        ("inputs:3", INPUT, 3),
        ("input register:3", INPUT, 3),
        ("input_registers:3", INPUT, 3),
        ("holding:16", HOLDING, 16),
        ("Holding_Register:16", HOLDING, 16),
        ("holding_registers:16", HOLDING, 16),
        ("holding:0x10", HOLDING, 16),
        ("coil:0XFFFF", COILS, 65535),
        # memory of a PLC, from 0
        ("%MW10", HOLDING, 10),
        ("%mw0", HOLDING, 0),
        ("%M10", COILS, 10),
        (" 4x1 ", HOLDING, 0),
    ],
)
def test_a_notation_names_table_and_offset(text: str, table: Table, offset: int) -> None:
    address = parse_address(text)
    assert (address.table, address.offset, address.bit) == (table, offset, None)
    assert address.text == text.strip()
    assert address.number == offset + 1
    assert parse_address(text, table=table) == address


def test_0x10_is_coil_number_10_and_never_hexadecimal() -> None:
    assert parse_address("0x10") == Address(COILS, 9)
    assert parse_address("coil:0x10") == Address(COILS, 16)
    assert parse_address(0x10, table=COILS) == Address(COILS, 16)  # an int is an offset, however it is spelt


@pytest.mark.parametrize("text", ["0x1F", "0xA", "0Xff"])
def test_what_looks_hexadecimal_is_refused_with_the_way_to_write_it(text: str) -> None:
    for table in (None, HOLDING):
        with pytest.raises(InvalidRequest, match=f"0x is the prefix of coils.*holding:0x{text[2:]}, coil:0x{text[2:]}"):
            parse_address(text, table=table)


def test_0x10_for_a_holding_register_is_refused_with_the_hexadecimal_notation() -> None:
    with pytest.raises(
        InvalidRequest, match=r"0x10 means coil number 10, not one of the holding registers; .*holding:0x10"
    ):
        parse_address("0x10", table=HOLDING)


@pytest.mark.parametrize("value", [0, 1, 10, 40001, 65535])
def test_an_integer_is_an_offset(value: int) -> None:
    assert parse_address(value) == Address(None, value)
    assert parse_address(value, table=INPUT) == Address(INPUT, value)
    assert str(parse_address(value)) == f"offset {value}"


@pytest.mark.parametrize("text", ["10", "0", "65535", "0001", "20001", "50000"])
def test_a_bare_decimal_text_is_an_offset_only_if_the_caller_names_the_table(text: str) -> None:
    assert parse_address(text, table=HOLDING) == Address(HOLDING, int(text))
    with pytest.raises(InvalidRequest, match="does not say which table nor whether it counts from 0 or 1"):
        parse_address(text)


def test_the_refusal_of_a_bare_decimal_shows_what_may_be_meant() -> None:
    with pytest.raises(InvalidRequest, match=r"4x11 or holding:10 for the holding register at offset 10, 3x11 or"):
        parse_address("10")
    with pytest.raises(InvalidRequest, match=r"4x10 or holding:10 for the holding register at offset 10"):
        parse_address("10", base=0)
    with pytest.raises(InvalidRequest, match=r"4x10 or holding:10 for the holding register at offset 9"):
        parse_address("10", base=1)


@pytest.mark.parametrize(
    ("value", "base", "offset"),
    [
        ("4x0", 0, 0),
        ("4x65535", 0, 65535),
        ("40000", 0, 0),
        ("40001", 0, 1),
        ("400000", 0, 0),
        ("465535", 0, 65535),
        ("4x1", 1, 0),
        ("40001", 1, 0),
        ("holding:1", 1, 0),
        ("holding:0x10", 1, 15),
        ("holding:65536", 1, 65535),
        ("holding:0", 0, 0),
        (1, 1, 0),
        (65536, 1, 65535),
        (0, 0, 0),
        ("1", 1, 0),
        ("1", 0, 1),
        ("%MW10", 0, 10),
        ("%MW10", 1, 10),
    ],
)
def test_a_declared_base_says_what_the_first_item_is_called(value: int | str, base: Literal[0, 1], offset: int) -> None:
    assert parse_address(value, table=HOLDING, base=base) == Address(HOLDING, offset)


def test_an_integer_of_thousands_of_digits_is_refused_in_a_short_sentence() -> None:
    with pytest.raises(InvalidRequest, match="there is no item") as caught:
        parse_address(10**6000)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    ("value", "base"),
    [
        (-1, None),
        (65536, None),
        (0, 1),
        (65537, 1),
        ("4x0", None),
        ("40000", None),
        ("00000", None),
        ("4x65537", None),
        ("465537", None),
        ("4x65536", 0),
        ("holding:65536", None),
        ("holding:0x10000", None),
        ("holding:0", 1),
        ("%MW65536", None),
    ],
)
def test_an_item_outside_the_table_is_refused_with_the_range(value: int | str, base: Literal[0, 1] | None) -> None:
    with pytest.raises(InvalidRequest, match=r"there is no .*; counted from [01], they are (0…65535|1…65536)"):
        parse_address(value, base=base)


@pytest.mark.parametrize(
    ("text", "table", "hint"),
    [
        ("40001", COILS, r"means holding register number 1, not one of the coils; for offset 40001 write coil:40001"),
        ("12345", HOLDING, r"means discrete input number 2345, not one of the holding registers; .* holding:12345"),
        ("00010", INPUT, r"means coil number 10, not one of the input registers; for offset 10 write input:10"),
        ("4x1", INPUT, r"means holding register number 1, not one of the input registers$"),
        ("%M1", HOLDING, r"means coil number 2, not one of the holding registers$"),
        ("400001", DISCRETE, r"means holding register number 1, not one of the discrete inputs$"),
    ],
)
def test_a_notation_of_another_table_than_the_callers_is_refused(text: str, table: Table, hint: str) -> None:
    with pytest.raises(InvalidRequest, match=hint):
        parse_address(text, table=table)


@pytest.mark.parametrize(
    ("text", "table", "offset", "bit"),
    [
        ("4x10.3", HOLDING, 9, 3),
        ("3x1.0", INPUT, 0, 0),
        ("40010.15", HOLDING, 9, 15),
        ("holding:16.7", HOLDING, 16, 7),
        ("holding:0x10.7", HOLDING, 16, 7),
        ("%MW10.3", HOLDING, 10, 3),
    ],
)
def test_a_register_may_be_followed_by_a_bit(text: str, table: Table, offset: int, bit: int) -> None:
    assert parse_address(text) == Address(table, offset, bit)


def test_a_bare_offset_may_be_followed_by_a_bit_if_the_table_is_known() -> None:
    assert parse_address("10.3", table=HOLDING) == Address(HOLDING, 10, 3)


@pytest.mark.parametrize("text", ["4x10.16", "%MW10.99"])
def test_a_bit_that_a_register_does_not_have_is_refused(text: str) -> None:
    with pytest.raises(InvalidRequest, match="a register has bits 0…15"):
        parse_address(text)


@pytest.mark.parametrize("text", ["0x10.3", "1x10.3", "coil:1.0", "%M10.3"])
def test_a_bit_of_a_bit_is_refused(text: str) -> None:
    with pytest.raises(InvalidRequest, match="is one bit and has no bit"):
        parse_address(text)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x",
        "4x",
        "4x-1",
        "2x1",
        "5x1",
        "4x1.",
        "4x1.2.3",
        "40001x",
        "%MD4",
        "%MX4",
        "MW4",
        "4 x 1",
        "4xA",
        "４x1",
        "-1",
        "1234567",
        "4x1234567",
        "holding:",
        "holding:x",
        "holding:-1",
        "holding:1:2",
        "0x",
        "tcp://host",
    ],
)
def test_what_is_no_notation_is_refused_with_those_that_exist(text: str) -> None:
    for table in (None, HOLDING):
        with pytest.raises(InvalidRequest, match=r"is no address; write 4x1 or 40001 .*holding:0x10.*%MW0"):
            parse_address(text, table=table)


@pytest.mark.parametrize("text", ["4x2:float32", "40001:2", "%MW7:int16"])
def test_what_follows_an_address_is_to_be_given_apart(text: str) -> None:
    address, rest = text.split(":")
    with pytest.raises(InvalidRequest, match=f"'{text}' is no address, '{address}' is; give '{rest}' apart from it"):
        parse_address(text)


def test_an_unknown_table_name_is_refused_with_those_that_exist() -> None:
    with pytest.raises(InvalidRequest, match="there is no table 'register', but coil, discrete, input, holding"):
        parse_address("register:1")


@pytest.mark.parametrize("value", [True, 1.0, None, b"4x1", ["4x1"]])
def test_what_is_neither_number_nor_text_is_refused(value: object) -> None:
    with pytest.raises(InvalidRequest, match="an address is an int or text"):
        parse_address(value)  # type: ignore[arg-type]


def test_a_base_other_than_0_and_1_is_refused() -> None:
    with pytest.raises(InvalidRequest, match="base is 2"):
        parse_address("4x1", base=2)  # type: ignore[arg-type]


def test_an_address_is_given_back_with_the_table_filled_in() -> None:
    known = parse_address("4x1")
    assert parse_address(known) is known
    assert parse_address(known, table=HOLDING) is known
    assert parse_address(Address(None, 5, 3), table=HOLDING) == Address(HOLDING, 5, 3)
    with pytest.raises(InvalidRequest, match="not one of the coils"):
        parse_address(known, table=COILS)
    with pytest.raises(InvalidRequest, match="has no bit 3"):
        parse_address(Address(None, 5, 3), table=COILS)


def test_addresses_are_equal_if_they_mean_the_same() -> None:
    spellings = ["4x17", "40017", "400017", "holding:16", "holding:0x10", "%MW16"]
    assert len({parse_address(text) for text in spellings}) == 1


@pytest.mark.parametrize(
    ("table", "offset", "bit"), [(HOLDING, -1, None), (HOLDING, 65536, None), (HOLDING, 0, 16), (COILS, 0, 0)]
)
def test_an_impossible_address_cannot_be_built(table: Table, offset: int, bit: int | None) -> None:
    with pytest.raises(InvalidRequest):
        Address(table, offset, bit)


def test_an_address_prints_as_it_was_written_or_in_the_notation_with_prefix() -> None:
    assert str(parse_address("holding:0x10")) == "holding:0x10"
    assert str(Address(HOLDING, 16)) == "4x17"
    assert str(Address(None, 16)) == "offset 16"
    assert str(Address(None, 16, 3)) == "offset 16.3"
    assert format_address(Address(COILS, 9)) == "0x10"
    assert format_address(Address(HOLDING, 9, 3)) == "4x10.3"


@given(
    value=st.integers(1, 65535) | st.sampled_from(["1", "40001", "4x1", "4x9.3", "holding:1", "holding:0x10", "%MW1"]),
    table=st.sampled_from([None, HOLDING]),
    base=st.sampled_from([None, 0, 1]),
)
@example(value=40001, table=None, base=None)
@example(value=40001, table=HOLDING, base=None)
@example(value="40001", table=None, base=0)
@example(value="holding:1", table=None, base=1)
def test_what_an_address_prints_is_read_as_no_other_address(
    value: int | str, table: Table | None, base: Literal[0, 1] | None
) -> None:
    try:
        address = parse_address(value, table=table, base=base)
    except InvalidRequest:
        return  # a bare text without a table
    if address.table is None:
        with pytest.raises(InvalidRequest):
            parse_address(str(address))
    else:
        assert parse_address(str(address), table=HOLDING) == address


def test_an_address_without_a_table_has_no_notation() -> None:
    with pytest.raises(InvalidRequest, match="offset 5 has no table"):
        format_address(Address(None, 5))


@given(table=st.sampled_from(list(Table)), offset=st.integers(0, 65535), bit=st.one_of(st.none(), st.integers(0, 15)))
def test_what_is_printed_is_read_back(table: Table, offset: int, bit: int | None) -> None:
    address = Address(table, offset, None if table.holds_bits else bit)
    assert parse_address(format_address(address)) == address
    assert parse_address(format_address(address), table=table) == address


@given(
    text=st.one_of(st.text(max_size=20), st.text("01234579xXaF:.%MWholding ", max_size=14)),
    table=st.sampled_from([None, *Table]),
    base=st.sampled_from([None, 0, 1]),
)
def test_any_text_is_an_address_or_refused(text: str, table: Table | None, base: Literal[0, 1] | None) -> None:
    try:
        address = parse_address(text, table=table, base=base)
    except InvalidRequest:
        return
    assert 0 <= address.offset <= 65535
    assert table is None or address.table is table


@pytest.mark.parametrize(
    ("name", "table"),
    [("holding", HOLDING), (" Input Registers", INPUT), ("discrete-input", DISCRETE), ("coils", COILS), ("4x", None)],
)
def test_a_table_is_found_by_each_of_its_names(name: str, table: Table | None) -> None:
    assert table_named(name) is table

"""What a device says of itself."""

from typing import Any

import pytest

from busway.errors import ConfigError
from busway.server.identity import identification_objects, server_id_data, status_source


def test_the_mandatory_objects_are_always_there_and_the_order_is_ascending() -> None:
    objects = identification_objects({4: "Pump", 1: b"P-1"})
    assert list(objects) == [0, 1, 2, 4]
    assert objects[1] == b"P-1"
    assert objects[4] == b"Pump"


def test_text_is_sent_as_utf_8_and_measured_so() -> None:
    assert identification_objects({4: "µ" * 122})[4] == "µ".encode() * 122
    with pytest.raises(ConfigError, match="at most 244 bytes, not 246"):
        identification_objects({4: "µ" * 123})


@pytest.mark.parametrize("objects", [{256: "x"}, {-1: "x"}, {"0": "x"}, {True: "x"}, {3: 5}, {3: b"x" * 245}])
def test_an_object_that_cannot_be_is_refused(objects: Any) -> None:
    with pytest.raises(ConfigError, match="identification"):
        identification_objects(objects)


def test_a_server_id_fits_one_reply() -> None:
    assert server_id_data(b"x" * 251) == b"x" * 251
    for wrong in (b"x" * 252, "text"):
        with pytest.raises(ConfigError, match="server_id"):
            server_id_data(wrong)  # type: ignore[arg-type]


def test_the_exception_status_is_a_number_or_asked_each_time() -> None:
    assert status_source(0x6D)() == 0x6D
    states = iter((1, 2))
    asked = status_source(lambda: next(states))
    assert (asked(), asked()) == (1, 2)
    for wrong in (256, -1, True, "1"):
        with pytest.raises(ConfigError, match="exception_status"):
            status_source(wrong)  # type: ignore[arg-type]

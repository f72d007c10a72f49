"""The comparison of masters whose slave answers late: its slave, and what it counts as right, wrong and error."""

import random

import late_replies
import pytest
from late_replies import Queue, answer, judged, requests_in

from busway.framing.rtu import encode_rtu


def test_slave_answers_in_order_and_a_late_answer_holds_up_those_behind_it() -> None:
    queue = Queue(service=0.03, late_part=0.0, late_by=1.3, chance=random.Random(1))
    assert [queue.leaves(0.0), queue.leaves(0.0), queue.leaves(5.0)] == pytest.approx([0.03, 0.06, 5.03])
    queue.late_part = 1.0
    assert [queue.leaves(6.0), queue.leaves(6.0)] == pytest.approx([7.33, 8.66])


def test_slave_answers_reads_with_the_address_and_its_count_and_anything_else_with_exception_01() -> None:
    heard = bytearray(encode_rtu(1, bytes.fromhex("03 0007 0002")) + encode_rtu(1, bytes.fromhex("2b0e0100")) + b"\x01")
    read, other = requests_in(heard)
    assert heard == b"\x01"
    assert answer(read, 258) == encode_rtu(1, bytes.fromhex("03 04 0007 0102"))
    assert answer(other, 259) == encode_rtu(1, bytes.fromhex("ab 01"))


def test_noise_before_a_request_is_dropped_in_the_end() -> None:
    heard = bytearray(b"\x55" + encode_rtu(1, bytes.fromhex("03 0007 0002")) * 8)
    assert len(list(requests_in(heard))) == 8


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([4, 1], (1, 0, 0)),
        ([3, 1], (0, 1, 0)),  # of another address
        ([4, 0], (0, 1, 0)),  # of the same address, asked before the call began
        ([4, 9], (0, 1, 0)),  # of no request at all
        (None, (0, 0, 1)),
    ],
)
def test_value_is_right_where_it_is_of_the_address_asked_and_of_a_request_of_its_call(
    values: list[int] | None, expected: tuple[int, int, int]
) -> None:
    found = judged("one", [[10.0, 10.5, 4, values, "" if values else "timeout"]], arrived=[9.0, 10.1])
    assert (found.right, found.wrong, found.errors) == expected
    assert found.seconds == pytest.approx(0.5)


def test_command_line_names_a_master_that_does_not_exist(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        late_replies.parsed(["--only", "busway,other"])
    assert "there is no master other" in capsys.readouterr().err
    assert late_replies.parsed([]).reads == 500

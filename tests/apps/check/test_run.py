"""A run: what is restored, what becomes of a device that dies, what is not offered, and what is only undecided."""

from typing import Any

import pytest
from checked_device import SIZE, VirtualDialer, VirtualWire, target_of

import busway
from busway.apps.check.catalogue import checks_for
from busway.apps.check.check import CheckResult, Level, Outcome
from busway.apps.check.run import CheckRun, Pace
from busway.errors import LinkDown


def run(dialer: VirtualDialer, level: Level = Level.DISRUPTIVE, only: Any = ()) -> dict[str, CheckResult]:
    """All results by the names of checks."""
    target = target_of(dialer.framing)
    return {one.check.id: one for one in CheckRun(dialer, target, Pace()).results(checks_for(target, level, only))}


def test_the_scratch_is_restored_and_nothing_else_was_written() -> None:
    dialer = VirtualDialer("mbap")
    registers, coils = list(dialer.device.holding_registers), list(dialer.device.coils)
    written: list[int] = []
    dialer.device.on_write("holding_registers", lambda change: written.append(change.address))
    results = run(dialer, Level.WRITE)
    assert results["scratch-restored"].outcome is Outcome.PASSED
    assert list(dialer.device.holding_registers) == registers
    assert list(dialer.device.coils) == coils
    assert written
    assert all(100 <= address < 108 for address in written)


@pytest.mark.parametrize("level", [Level.READ, Level.DIAG])
def test_nothing_is_written_below_the_level_for_it(level: Level) -> None:
    dialer = VirtualDialer("rtu")
    for table in ("holding_registers", "coils"):
        dialer.device.on_write(table, lambda change: pytest.fail("it was written"))
    assert "scratch-restored" not in run(dialer, level)


class ForgetfulDevice(VirtualDialer):
    """A device that says it has written what register 103 held at first, and has not."""

    def answer(self, unit: int, pdu: bytes) -> bytes:
        if pdu[0] == 16 and pdu[6:8] == (100).to_bytes(2, "big"):
            return pdu[:5]
        if pdu[0] == 6 and pdu[3:5] == (103).to_bytes(2, "big"):
            return pdu
        return super().answer(unit, pdu)


def test_what_cannot_be_restored_fails() -> None:
    result = run(ForgetfulDevice("mbap"), Level.WRITE)["scratch-restored"]
    assert result.outcome is Outcome.FAILED
    assert "from 100 on do not hold what they held before" in result.reason


def test_the_coils_are_restored_also_where_the_registers_cannot_be() -> None:
    dialer = ForgetfulDevice("mbap")
    registers, coils = dialer.device.holding_registers, list(dialer.device.coils)
    dialer.device.on_write("coils", lambda change: registers.__setitem__(103, 7))
    result = run(dialer, Level.WRITE, ["fc05-off"])["scratch-restored"]
    assert result.reason == "holding registers from 100 on do not hold what they held before"
    assert list(dialer.device.coils) == coils


class UnchangingDevice(ForgetfulDevice):
    """A device that also says it has written coil 100 when it is switched on, and leaves it off."""

    def answer(self, unit: int, pdu: bytes) -> bytes:
        reply = super().answer(unit, pdu)
        if pdu[0] in (5, 15) and len(reply) == 5:
            self.device.coils[100] = False
        return reply


def test_each_table_that_cannot_be_restored_is_named() -> None:
    reason = run(UnchangingDevice("mbap"), Level.WRITE)["scratch-restored"].reason
    assert reason == (
        "holding registers from 100 on do not hold what they held before; "
        "coils from 100 on do not hold what they held before"
    )


def test_scratch_items_that_cannot_be_read_are_not_written() -> None:
    dialer = VirtualDialer("mbap", busway.Device(holding_registers=50, coils=SIZE))
    dialer.device.on_write("coils", lambda change: pytest.fail("it was written"))
    results = run(dialer, Level.WRITE)
    assert results["fc05-echo"].outcome is Outcome.UNDECIDED
    assert "nothing is written" in results["fc05-echo"].reason


def test_a_function_that_is_not_offered_is_no_failure_and_its_checks_are_not_run() -> None:
    dialer = VirtualDialer("mbap")
    dialer.device.functions = [1, 3, 16]
    results = run(dialer)
    assert {one.outcome for one in results.values()} == {Outcome.PASSED, Outcome.NOT_OFFERED}
    assert results["fc43-basic"].outcome is Outcome.NOT_OFFERED
    assert results["fc43-code-5"].evidence == ()


class DyingWire(VirtualWire):
    """Ends the device at a protocol identifier other than 0."""

    def send(self, data: bytes) -> None:
        if len(data) > 7 and data[2:4] != b"\x00\x00":
            self._dialer.is_dead = True
            self._ended = True
            return
        super().send(data)


class DyingDialer(VirtualDialer):
    """A device that a damaged frame kills."""

    def open(self) -> VirtualWire:
        if self.is_dead:
            raise LinkDown("the device is dead")
        return DyingWire(self)


def test_a_device_that_dies_ends_the_run_and_the_check_that_killed_it_is_named() -> None:
    results = run(DyingDialer("mbap"), Level.DIAG)
    aborted = [name for name, one in results.items() if one.outcome is Outcome.ABORTED]
    assert aborted[0] == "protocol-1"
    assert results["protocol-1"].evidence[0].data[2:4] == b"\x00\x01"
    assert results[aborted[1]].reason == "the device had died before"


class LeavingWire(VirtualWire):
    """Ends the device as soon as the scratch registers are read."""

    def send(self, data: bytes) -> None:
        if data[7:12] == bytes.fromhex("03 0064 0008"):
            self._dialer.is_dead = True
            raise LinkDown("the device closed the connection")
        super().send(data)


class LeavingDialer(DyingDialer):
    """A device that is gone when the first check that writes is due."""

    def open(self) -> VirtualWire:
        super().open().close()
        return LeavingWire(self)


def test_a_device_that_is_gone_when_the_scratch_is_saved_aborts_the_checks_and_the_run_still_has_all_results() -> None:
    dialer = LeavingDialer("mbap")
    results = run(dialer, Level.WRITE)
    assert list(results) == [one.id for one in checks_for(target_of("mbap"), Level.WRITE, ())] + ["scratch-restored"]
    first, *others = [one for one in results.values() if one.outcome is Outcome.ABORTED]
    assert first.check.writes
    assert first.reason.startswith("no connection any more: the device is dead")
    assert others
    assert {one.reason for one in others} == {"the device had died before"}
    assert results["scratch-restored"].reason == "nothing was written"


class SilentLine(VirtualDialer):
    """A device on a line that hears nothing more after a broadcast."""

    def answer(self, unit: int, pdu: bytes) -> bytes:
        if pdu[0] == 0x40:
            self.is_dead = True
        return super().answer(unit, pdu)


def test_a_device_on_a_line_that_falls_silent_ends_the_run_too() -> None:
    results = run(SilentLine("rtu"), Level.DIAG)
    assert results["broadcast-unknown"].outcome is Outcome.ABORTED
    assert results["broadcast-unknown"].reason == "the device died: it no longer answers"


class SegmentDialer(VirtualDialer):
    """A device that answers one request of each segment: what comes with another one, unanswered yet, is dropped."""

    def open(self) -> VirtualWire:
        return SegmentWire(self)


class SegmentWire(VirtualWire):
    """A connection to it. Requests of one moment come in one segment."""

    _unanswered_since = -1.0

    def send(self, data: bytes) -> None:
        if self._dialer.now() == self._unanswered_since:
            return
        self._unanswered_since = self._dialer.now()
        end = 6 + int.from_bytes(data[4:6], "big")
        is_followed = len(data) > end + 8 and data[end + 2 : end + 4] == b"\0\0"
        super().send(data[:end] if is_followed else data)

    def receive(self, timeout: float) -> bytes | None:
        came = super().receive(timeout)
        if came:
            self._unanswered_since = -1.0
        return came


def test_a_device_that_drops_the_second_request_of_a_segment_fails_the_checks_about_that_alone() -> None:
    results = run(SegmentDialer("mbap"))
    told = {name for name, one in results.items() if one.outcome is not Outcome.PASSED}
    assert told == {"together-2", "together-4", "together-16"}


def test_no_connection_at_the_beginning_is_an_error() -> None:
    dialer = VirtualDialer("mbap")
    dialer.is_dead = True
    with pytest.raises(LinkDown):
        run(dialer)


class CarelessDevice(VirtualDialer):
    """A device that executes a read although its count is 0, and answers a write before it refuses its count."""

    def answer(self, unit: int, pdu: bytes) -> bytes:
        if pdu[0] == 3 and pdu[3:5] == b"\x00\x00":
            return b"\x03\x00"
        if pdu[0] == 23 and pdu[3:5] == b"\x00\x7e":
            super().answer(unit, b"\x10" + pdu[5:])
        return super().answer(unit, pdu)


def test_a_request_that_is_executed_though_it_must_be_refused_fails() -> None:
    results = run(CarelessDevice("ascii"))
    assert [name for name, one in results.items() if one.outcome is not Outcome.PASSED] == [
        "fc03-count-0",
        "fc03-count-before-address",
        "fc23-read-over",
    ]
    assert results["fc03-count-0"].reason == "the request was executed, where exception 03 is right"
    assert "where 03 04 11 11 22 22 is right" in results["fc23-read-over"].reason


class HalfWire(VirtualWire):
    """A connection on which the first reply of a function stops in the middle; the rest comes after the timeout."""

    def receive(self, timeout: float) -> bytes | None:
        dialer = self._dialer
        assert isinstance(dialer, HalfDialer)
        if dialer.rest and dialer.now() >= dialer.rest_at:
            rest, dialer.rest = dialer.rest, b""
            return rest
        came = super().receive(timeout)
        if came and came[7] == dialer.function and not dialer.half:
            dialer.half, dialer.rest = came[:9], came[9:]
            dialer.rest_at = dialer.now() + Pace().timeout
            return dialer.half
        return came


class HalfDialer(VirtualDialer):
    """A device with such a connection."""

    function = 4
    half = rest = b""
    rest_at = 0.0

    def open(self) -> VirtualWire:
        return HalfWire(self)


def test_a_reply_that_is_late_from_its_middle_on_fails_its_own_check_alone_and_is_shown_as_it_came() -> None:
    dialer = HalfDialer("mbap")
    failed = {name: one for name, one in run(dialer, Level.READ).items() if one.outcome is Outcome.FAILED}
    assert dialer.half
    assert not dialer.rest
    (only,) = failed.values()
    assert "fc04" in only.check.id
    assert dialer.half in [one.data for one in only.evidence]

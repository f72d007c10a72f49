"""Each fault profile that can be seen fails exactly the checks that are about it; a right device passes all.

In virtual time: no socket, no port, no waiting.
"""

from collections.abc import Mapping
from typing import Any

import pytest
from checked_device import UNIT, VirtualDialer, target_of

from busway.apps.check.catalogue import checks_for
from busway.apps.check.check import CheckResult, Level, Outcome
from busway.apps.check.run import CheckRun, Pace
from busway.faults.applied_faults import Selection
from busway.faults.profiles import FAULT_PROFILES
from busway.testing import Carrier

FRAMINGS = ["mbap", "rtu", "ascii"]
WRITES = {5, 6, 15, 16, 22, 23}

EVERYWHERE: Mapping[str, tuple[dict[str, Any], set[str]]] = {
    "late": ({}, {"answers"}),
    "queue-lag": ({}, {"answers"}),
    "unit=255": ({}, {"unit-echoed"}),
    "unit=0": ({}, {"unit-echoed"}),
    "unit=1": ({}, {"unit-echoed"}),
    "mute-after-connect": ({}, {"answers"}),
    "wedged": ({}, {"answers"}),
    "min-gap": ({}, {"answers-at-once"}),
    "max-block": ({}, {f"fc0{code}-count-most" for code in (1, 2, 3, 4)}),
    "hole": ({}, {"probe-readable"}),
    "wide-register": ({}, {"reply-form"}),
    "short": ({}, {"reply-form"}),
    "long": ({}, {"reply-form"}),
    "busy": ({}, {"probe-readable"}),
    "wrong-echo": ({}, {"fc05-echo", "fc06-echo", "fc15-answers", "fc16-answers", "fc22-echo"}),
    "odd-exception": ({}, {"probe-readable"}),
    "fc6-only": ({}, {"fc15-answers", "fc16-answers"}),
    "fc16-only": ({}, {"fc05-echo", "fc06-echo"}),
}
ON_TCP: Mapping[str, tuple[dict[str, Any], set[str]]] = {
    "foreign-transaction": ({}, {"transaction-echoed"}),
    "transaction+1": ({}, {"transaction-echoed"}),
    "transaction=0": ({}, {"transaction-echoed"}),
    "transaction=random": ({}, {"transaction-echoed"}),
    "close-if-silent": ({}, {"silent-start"}),
    "idle-close": ({"seconds": 1.5}, {"silent-start", "idle"}),
    "single-client": ({}, {"second-connection"}),
    "unit-switch": ({}, {"unit-0", "unit-255", "after-other-unit"}),
    "execute-then-drop": (
        {},
        {"fc05-echo", "fc06-echo", "fc15-answers", "fc16-answers", "fc22-echo", "fc23-answers"},
    ),
}
ON_LINES: Mapping[str, tuple[dict[str, Any], set[str]]] = {
    "leading-zero": ({}, {"nothing-else"}),
    "noise": ({}, {"nothing-else"}),
    "echo": ({}, {"nothing-else"}),
    "broadcast-reply": ({}, {"broadcast-write"}),
    "unit-switch": ({}, {"broadcast-read", "broadcast-bad-count", "broadcast-write"}),
}
UNSEEN = {
    "dribble": "a stream may arrive in any pieces, and so may what a serial port gives",
    "glue": "the same: frames may arrive together",
}
"""What no check can be about, because the documents allow it."""


def checked(framing: str, name: str = "", **parameters: Any) -> list[CheckResult]:
    """All results for a device with a fault."""
    dialer = VirtualDialer(framing)
    if name:
        # Unknown functions may write too, for that fault; here it is about those that do.
        functions = WRITES if name == "execute-then-drop" else None
        dialer.faults.add(FAULT_PROFILES.named(name)(**parameters), Selection(functions=functions))
    target = target_of(framing)
    before = dialer.device.holding_registers[100:108], dialer.device.coils[100:108]
    results = list(CheckRun(dialer, target, Pace()).results(checks_for(target, Level.DISRUPTIVE)))
    assert (dialer.device.holding_registers[100:108], dialer.device.coils[100:108]) == before
    return results


def failed(results: list[CheckResult]) -> set[str]:
    """The checks that a device failed, or was warned of."""
    assert not any(one.outcome is Outcome.ABORTED for one in results)
    return {one.check.id for one in results if one.outcome in (Outcome.FAILED, Outcome.WARNED)}


@pytest.mark.parametrize("framing", FRAMINGS)
def test_a_right_device_passes_every_check(framing: str) -> None:
    assert {one.outcome for one in checked(framing)} == {Outcome.PASSED}


@pytest.mark.parametrize("name", [*EVERYWHERE, *ON_TCP])
def test_a_fault_on_tcp_fails_the_checks_about_it_and_no_other(name: str) -> None:
    parameters, expected = {**EVERYWHERE, **ON_TCP}[name]
    assert failed(checked("mbap", name, **parameters)) == expected


@pytest.mark.parametrize("name", [*EVERYWHERE, *ON_LINES])
def test_a_fault_on_a_line_fails_the_checks_about_it_and_no_other(name: str) -> None:
    parameters, expected = {**EVERYWHERE, **ON_LINES}[name]
    assert failed(checked("rtu", name, **parameters)) == expected


@pytest.mark.parametrize("name", ["late", "short", "wrong-echo", *ON_LINES])
def test_a_fault_on_an_ascii_line_fails_them_too(name: str) -> None:
    parameters, expected = {**EVERYWHERE, **ON_LINES}[name]
    assert failed(checked("ascii", name, **parameters)) == expected


@pytest.mark.parametrize("framing", ["mbap", "rtu"])
@pytest.mark.parametrize("name", UNSEEN)
def test_what_the_documents_allow_fails_nothing(framing: str, name: str) -> None:
    assert failed(checked(framing, name)) == set()


def test_every_fault_profile_is_in_one_table() -> None:
    assert {*EVERYWHERE, *ON_TCP, *ON_LINES, *UNSEEN} == set(FAULT_PROFILES)
    for name in ON_LINES:
        if name != "unit-switch":
            assert FAULT_PROFILES[name].carriers == {Carrier.SERIAL}


def test_a_failure_shows_its_bytes_in_the_dissectors_words() -> None:
    (one,) = [result for result in checked("mbap", "unit=1") if result.outcome is Outcome.FAILED]
    assert one.reason == f"unit 1 answers where unit {UNIT} was asked"
    sent, received = one.evidence
    assert (sent.sent, received.sent) == (True, False)
    assert sent.words.startswith("MBAP, transaction")
    assert "3 (read holding registers), reply" in received.words
    assert received.data[6] == 1


@pytest.mark.parametrize("name", ["late", "queue-lag", "transaction+1", "short", "busy"])
def test_behind_a_basic_failure_nothing_more_is_sent_or_claimed(name: str) -> None:
    results = checked("mbap", name)
    last = max(number for number, one in enumerate(results) if one.outcome is Outcome.FAILED)
    assert {one.outcome for one in results[last + 1 :]} == {Outcome.UNDECIDED}
    assert not any(one.evidence for one in results[last + 1 :])

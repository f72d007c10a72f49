"""What a client's run counts: all that ends between two points of time, divided by the time between them."""

import json
import time

import pytest
from harness.window import Window


def test_callers_in_step_are_not_counted_as_if_a_round_took_no_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 100.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    window = Window(0.05)  # warms up for 0.1 s
    going = [True] * 16
    while any(going):
        began, now = now, now + 0.02  # sixteen callers report eight each, microseconds apart
        going = []
        for _ in range(16):
            now += 0.000_001
            going.append(window.count(8, began))
    window.report()
    told = json.loads(capsys.readouterr().out)
    assert told["seconds"] == 0.05
    assert told["rate"] == pytest.approx(128 / 0.02, rel=0.25)
    assert told["all_transactions"] % 128 == 0

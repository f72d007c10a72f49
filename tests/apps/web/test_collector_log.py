"""The messages of a collector on its page: bounded, by level and words, and never in the way of other handlers."""

import logging

import pytest

from busway.apps.web import collector_log
from busway.apps.web.collector_log import CollectorLog

LOG = logging.getLogger("busway.collector.of.tests")


def test_the_newest_messages_come_first_with_level_and_source() -> None:
    with CollectorLog() as log:
        LOG.info("begun")
        LOG.warning("pump %s", "silent")
        LOG.debug("not kept")
    found = log.lines(10, "info", "")
    assert [(line.level, line.source, line.text) for line in found.lines] == [
        ("warning", "collector.of.tests", "pump silent"),
        ("info", "collector.of.tests", "begun"),
    ]
    assert found.lines[0].number > found.lines[1].number


def test_they_are_found_by_level_and_words() -> None:
    with CollectorLog() as log:
        LOG.info("pump begun")
        LOG.warning("pump silent")
        LOG.error("disk full")
    assert [line.text for line in log.lines(10, "warning", "").lines] == ["disk full", "pump silent"]
    assert [line.text for line in log.lines(10, "info", "PUMP begun").lines] == ["pump begun"]
    assert [line.text for line in log.lines(1, "info", "").lines] == ["disk full"]


def test_the_oldest_are_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collector_log, "MOST_LINES", 3)
    with CollectorLog() as log:
        for number in range(10):
            LOG.info("%d", number)
    found = log.lines(10, "info", "")
    assert [line.text for line in found.lines] == ["9", "8", "7"]
    assert found.dropped == 7


def test_a_long_message_is_cut_and_a_name_forges_no_line() -> None:
    with CollectorLog() as log:
        LOG.info("x" * 10_000)
        LOG.info("pump\nERROR forged\x1b[2J")
    newest, cut = log.lines(10, "info", "").lines
    assert "\n" not in newest.text
    assert "\x1b" not in newest.text
    assert len(cut.text) == collector_log.LONGEST_LINE


def test_a_message_that_cannot_be_formatted_harms_no_other(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging, "raiseExceptions", True)  # the command line sets it otherwise, for its process
    with CollectorLog() as log:
        log.handle(logging.LogRecord("busway.x", logging.INFO, "x", 1, "%d", ("text",), None))
        LOG.info("after")
    assert [line.text for line in log.lines(10, "info", "").lines] == ["after"]
    assert "Logging error" in capsys.readouterr().err


def test_levels_and_handlers_are_as_before_when_the_page_has_gone() -> None:
    logger = logging.getLogger("busway")
    before = logger.level, list(logger.handlers)
    with CollectorLog():
        assert logger.isEnabledFor(logging.INFO)
    assert (logger.level, list(logger.handlers)) == before


def test_a_program_without_handlers_still_shows_warnings(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    class Last(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            shown.append(record.getMessage())

    monkeypatch.setattr(logging, "lastResort", Last(logging.WARNING))
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    with CollectorLog():
        LOG.warning("seen")
        LOG.info("not seen")
    assert shown == ["seen"]

"""Reports and summaries: what they count, what a baseline excuses, and that texts of a device stay texts."""

import json
from xml.etree import ElementTree

import pytest
from checked_device import VirtualDialer, target_of

from busway.apps.check.catalogue import checks_for
from busway.apps.check.check import Check, CheckResult, Evidence, Level, Outcome, Strength
from busway.apps.check.reports import REPORT_BEGINNINGS, REPORTS, hex_of
from busway.apps.check.run import CheckRun, Pace
from busway.apps.check.summary import Summary, baseline_of
from busway.errors import ConfigError


def result(name: str, outcome: Outcome, word: Strength = Strength.MUST) -> CheckResult:
    check = Check(name, "A10", "does what <it> & no other does", word, Level.READ, ())
    evidence = (Evidence(True, b"\x01\x03", "a request"), Evidence(False, b"", "the device closed the connection"))
    return CheckResult(check, outcome, f"because of <{name}>", evidence)


MANY = tuple(result(one.value, one) for one in Outcome)


def summary(results: tuple[CheckResult, ...] = MANY, **baseline: str) -> Summary:
    return Summary("tcp://10.0.0.5", 1, "read", results, baseline)


def test_only_a_failed_must_fails_and_only_an_aborted_check_aborts() -> None:
    assert [one.check.id for one in summary().failures] == ["fail"]
    assert summary().is_aborted
    assert not summary((result("w", Outcome.WARNED), result("u", Outcome.UNDECIDED))).failures


def test_what_failed_before_does_not_fail_and_what_changed_is_told() -> None:
    now = summary((result("a", Outcome.FAILED), result("b", Outcome.FAILED)), a="fail", b="pass")
    assert [one.check.id for one in now.failures] == ["b"]
    assert now.changes == (("b", "pass", "fail"),)


def test_a_json_report_is_a_baseline() -> None:
    text = REPORTS["json"](summary())
    assert baseline_of(json.loads(text), "last.json") == {one.value: one.value for one in Outcome}
    assert json.loads(text)["checks"][0]["evidence"][0] == {"sent": True, "bytes": "0103", "words": "a request"}


@pytest.mark.parametrize("report", [[], {}, {"schema": 2, "checks": []}, {"schema": 1, "checks": [1]}, "x"])
def test_another_file_is_no_baseline(report: object) -> None:
    with pytest.raises(ConfigError, match=r"last\.json"):
        baseline_of(report, "last.json")


def test_junit_counts_and_has_one_case_for_each_check() -> None:
    suite = ElementTree.fromstring(REPORTS["junit"](summary()))
    assert suite.attrib["tests"] == "6"
    assert (suite.attrib["failures"], suite.attrib["errors"], suite.attrib["skipped"]) == ("1", "1", "2")
    assert len(suite.findall("testcase")) == 6
    failure = suite.find("testcase[@name='fail']/failure")
    assert failure is not None
    assert failure.attrib["message"] == "because of <fail>"
    assert "-> 01 03   a request" in (failure.text or "")


def test_html_escapes_and_loads_nothing() -> None:
    page = REPORTS["html"](summary())
    assert "<it>" not in page
    assert "&lt;it&gt; &amp; no other" in page
    assert "http" not in page.replace("tcp://10.0.0.5", "")
    assert "<script" not in page


def test_markdown_has_a_row_for_each_check_and_the_bytes_of_failures() -> None:
    page = REPORTS["md"](summary(MANY, **{"pass": "fail"}))
    assert page.count("| A10 |") == 6
    assert "## fail: fail" in page
    assert "-> 01 03   a request" in page
    assert "| pass | fail | pass |" in page


def test_long_bytes_are_cut_with_their_number() -> None:
    assert hex_of(bytes(41)).endswith("… (41 bytes)")
    assert hex_of(bytes(40)) == " ".join(["00"] * 40)


@pytest.mark.parametrize("form", REPORTS)
def test_every_form_takes_a_real_run(form: str) -> None:
    dialer = VirtualDialer("mbap")
    dialer.add("unit=1")
    results = CheckRun(dialer, target_of("mbap"), Pace()).results(checks_for(target_of("mbap"), Level.READ))
    assert "unit-echoed" in REPORTS[form](summary(tuple(results)))


def test_each_report_begins_as_older_reports_are_known_by() -> None:
    assert REPORTS.keys() == REPORT_BEGINNINGS.keys()
    for name, form in REPORTS.items():
        assert form(summary()).encode().startswith(REPORT_BEGINNINGS[name])

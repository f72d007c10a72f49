"""The page on security: its code runs, its policies are policies, every key of rules and of the audit log is told."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from busway.access.audit_line import audit_line
from busway.cli.program import app
from busway.config.files.policy import PolicySection, RuleSection, parse_policy_file
from busway.pdu.write_items import WriteSingleRegister
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import Judged, RequestContext

PAGE = Path(__file__).resolve().parents[2] / "docs" / "security.md"


@pytest.fixture(scope="module")
def text() -> str:
    return PAGE.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def policies(text: str) -> list[str]:
    blocks: list[str] = re.findall(r"^```toml\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    return [block for block in blocks if block.startswith("[policy]")]


def test_its_code_runs_and_prints_what_it_says(run_page: Callable[[Path], None]) -> None:
    run_page(PAGE)


def test_its_policies_are_policies(policies: list[str]) -> None:
    assert [len(parse_policy_file(block, "security.md").policy.rules) for block in policies] == [0, 4]


@pytest.mark.clause("M6")
def test_what_it_says_of_a_command_is_what_the_command_says(text: str, policies: list[str], tmp_path: Path) -> None:
    (tmp_path / "plant.toml").write_text(policies[1], encoding="utf-8")
    commands = re.findall(r"^\$ busway (policy test .+)\n(.+)$", text, re.MULTILINE)
    assert commands
    for command, output in commands:
        words = [str(tmp_path / word) if word == "plant.toml" else word for word in shlex.split(command)]
        assert CliRunner().invoke(app, words).stdout == output + "\n"


def test_every_key_of_a_rule_is_told(text: str) -> None:
    told = set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
    assert set(RuleSection.model_fields) <= told
    assert all(f"{key} = " in text or f"`{key}`" in text for key in PolicySection.model_fields if key != "rule")


def test_every_key_of_a_line_is_told(text: str) -> None:
    context = RequestContext(unit=1, function=6, diagnostics=CommunicationState())
    context.judged = Judged("rule")
    line = audit_line(context, WriteSingleRegister(0, 1), "", "done", None)
    rows = "".join(re.findall(r"^\| (`.+?) \|", text, re.MULTILINE))
    assert all(f"`{key}`" in rows for key in re.findall(r'"(\w+)":', line))

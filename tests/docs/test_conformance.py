"""The conformance page is up to date, its names are those of the code, and what it claims has tests."""

import importlib
import re
import subprocess
import sys
import tomllib
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
DATA: dict[str, Any] = tomllib.loads((ROOT / "docs" / "conformance.toml").read_text(encoding="utf-8"))
CLAUSES = {one["id"]: one for one in DATA["clause"]}
NAMES = sorted({name for one in DATA["mapping"] for name in one["ours"]})
MEMBERS_OF_CHAPTER_5 = {
    "CMODBUSServer": "GlobalState CMODBUSServer m_InitServerFunctions m_ServerFunction m_Reset "
    "m_ServerReceivingMessage m_Start m_Stop m_tServerMODBUS m_BuildMODBUSException",
    "CMODBUSClient": "GlobalState CMODBUSClient m_ClientReceivingMessage m_ClientReceivingResponse m_Reset m_Start "
    "m_Stop m_tClientMODBUS",
    "CInterfaceIndicationMsg": "m_MODBUSConfirmation m_MODBUSIndication",
    "CInterfaceResponseMsg": "m_GetMemoryConnexion m_MODBUSRequest m_MODBUSResponse",
    "CConnexionMngt": "GlobalState NbConnectionSupported NbLocalConnection NbRemoteConnection CConnexionMngt "
    "m_EventOnSocket m_IsConnectionAuthorized m_IsConnexionRequest m_AcceptConnexion m_ReceiveData m_Reset m_SendData "
    "m_Start m_Stop",
    "CInterfaceConnexion": "m_GetObjectConnexion",
    "CItemConnexion": "",
    "CTCPConnexion": "read write",
    "CMBAP": "m_IsMdbHeaderCorrect",
    "CStackTCP_IP": "",
    "CTransaction": "",
    "CInterfaceUserApplication": "m_Read m_WriteData",
    "TConfigureObject": "",
    "COperatingMode": "m_Configure",
}


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "scripts/conformance.py", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )


def test_the_page_is_what_the_generator_makes_of_the_data_and_the_markers() -> None:
    done = run("--check")
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_clause_that_is_said_to_hold_has_a_test() -> None:
    done = run("--missing")
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_clause_of_the_documents_is_listed_once_and_in_order() -> None:
    expected = [
        f"{letter}{number}"
        for letter, most in (("A", 24), ("T", 42), ("S", 22), ("M", 6))
        for number in range(1, most + 1)
    ]
    assert [one["id"] for one in DATA["clause"]] == expected


def test_what_is_missing_is_said_where_a_clause_holds_in_part_only() -> None:
    assert {one["state"] for one in DATA["clause"]} <= {"done", "partial", "later"}
    assert [one["id"] for one in DATA["clause"] if ("lacks" in one) != (one["state"] == "partial")] == []


@pytest.mark.clause("T42")
@pytest.mark.parametrize("name", NAMES)
def test_each_counterpart_of_chapter_5_is_there(name: str) -> None:
    assert resolved(name) is not None


@pytest.mark.clause("T42")
def test_every_class_and_member_of_chapter_5_is_mapped() -> None:
    for guide_class, members in MEMBERS_OF_CHAPTER_5.items():
        mapped = " ".join(one["member"] for one in DATA["mapping"] if one["class"] == guide_class)
        assert mapped, guide_class
        for member in members.split():
            assert re.search(rf"\b{member}\b", mapped), f"{guide_class}.{member}"


@pytest.mark.clause("T42")
def test_a_member_without_a_counterpart_says_so() -> None:
    assert [one["member"] for one in DATA["mapping"] if not one["ours"] and "not yet" not in one.get("note", "")] == []


@pytest.mark.clause("A24")
@pytest.mark.parametrize(
    "printed",
    ["0x82", "0x14", "0E", "04A1", "write-only", "t1.5", "Register 5", "At least", "252", "TXD1–TXD0", "256", "0x78"],
)
def test_each_misprint_of_the_documents_is_listed_with_what_holds(printed: str) -> None:
    assert [one for one in DATA["misprint"] if printed in one["printed"] and one["holds"]]


@pytest.mark.clause("A2")
def test_the_silence_above_function_127_is_stated_as_a_deviation() -> None:
    (deviation,) = [one for one in DATA["deviation"] if one["clause"].startswith("A2,")]
    assert "128 to 255 gets no answer" in deviation["instead"]
    page = (ROOT / "docs" / "conformance.md").read_text(encoding="utf-8")
    assert deviation["instead"] in page.partition("## Deviations")[2]


@pytest.mark.clause("T11")
def test_joined_frames_are_stated_as_a_deviation_with_the_option_that_ends_it() -> None:
    (deviation,) = [one for one in DATA["deviation"] if one["clause"].startswith("T11")]
    assert "single_adu_segments" in deviation["option"]


def resolved(name: str) -> object:
    """What a dotted name stands for: a module's attribute, or one of its class; a field counts as one."""
    parts = name.split(".")
    for length in range(len(parts) - 1, 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            if is_dataclass(found) and part in {field.name for field in fields(found)}:
                return part
            found = getattr(found, part)
        return found
    raise AssertionError(name)

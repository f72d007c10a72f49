"""What the conformance page claims follows from the states of the clauses, and from nothing else."""

import importlib.util
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
DATA: dict[str, Any] = tomllib.loads((ROOT / "docs" / "conformance.toml").read_text(encoding="utf-8"))
WORDS = {"client", "server", "regular", "network", "gateway"}

pytestmark = pytest.mark.clause("S21")


def generator() -> ModuleType:
    """The script that writes the page."""
    if str(ROOT / "scripts") not in sys.path:
        sys.path.append(str(ROOT / "scripts"))
    path = ROOT / "scripts" / "conformance.py"
    spec = importlib.util.spec_from_file_location("conformance_script", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["conformance_script"] = module
    spec.loader.exec_module(module)
    return module


MODULE = generator()


def clause(id_: str, word: str | None, state: str = "done", *concerns: str) -> dict[str, Any]:
    made: dict[str, Any] = {"id": id_, "state": state, "concerns": list(concerns)}
    return made if word is None else made | {"word": word}


def claimed(clauses: list[dict[str, Any]], deviations: list[dict[str, Any]] | None = None, letters: str = "S") -> Any:
    kind = {"id": "x", "name": "x", "letters": letters, "is": ["server"]}
    (claim,) = MODULE.claims({"class": [kind], "clause": clauses, "deviation": deviations or []})
    return claim


def test_all_musts_and_shoulds_make_it_unconditional() -> None:
    claim = claimed([clause("S1", "must"), clause("S2", "should"), clause("S3", "may", "later"), clause("S4", None)])
    assert (claim.verdict, claim.musts, claim.shoulds) == (MODULE.UNCONDITIONAL, (), ())


@pytest.mark.parametrize("state", ["partial", "later"])
def test_all_musts_but_not_all_shoulds_make_it_conditional(state: str) -> None:
    claim = claimed([clause("S1", "must"), clause("S2", "should", state)])
    assert (claim.verdict, claim.shoulds) == (MODULE.CONDITIONAL, ("S2",))


@pytest.mark.parametrize("state", ["partial", "later"])
def test_one_must_that_does_not_hold_whole_makes_it_none(state: str) -> None:
    claim = claimed([clause("S1", "must", state), clause("S2", "should")])
    assert (claim.verdict, claim.musts) == (MODULE.NONE, ("S1",))


def test_clauses_of_others_do_not_count() -> None:
    clauses = [
        clause("S1", "must"),
        clause("T1", "must", "later"),
        clause("S2", "must", "later", "client"),
        clause("S3", "must", "later", "server", "regular"),
        clause("S4", "must", "done", "server"),
    ]
    assert claimed(clauses).verdict == MODULE.UNCONDITIONAL


def test_a_deviation_that_the_preset_ends_is_named_and_one_that_nothing_ends_counts() -> None:
    clauses = [clause("S1", "must"), clause("S2", "should"), clause("S3", "must")]
    ended = {"clause": "S1, section 2: this", "preset": ["option"]}
    claim = claimed(clauses, [ended])
    assert (claim.verdict, claim.preset) == (MODULE.UNCONDITIONAL, ("S1",))
    assert claimed(clauses, [ended, {"clause": "S2: that"}]).verdict == MODULE.CONDITIONAL
    assert claimed(clauses, [{"clause": "S3: that"}]).verdict == MODULE.NONE
    assert claimed(clauses, [{"clause": "S3: that", "word": "should"}]).verdict == MODULE.CONDITIONAL
    assert claimed(clauses, [{"clause": "S3: that", "word": "may"}]).verdict == MODULE.UNCONDITIONAL
    assert claimed(clauses, [{"clause": "S3: that", "concerns": ["client"]}]).verdict == MODULE.UNCONDITIONAL


def test_the_page_says_what_is_claimed_of_every_class() -> None:
    page = (ROOT / "docs" / "conformance.md").read_text(encoding="utf-8")
    for one in MODULE.claims(DATA):
        assert f"| {one.name} | {one.verdict}" in page


def test_clauses_classes_and_deviations_use_the_same_words() -> None:
    for one in (*DATA["clause"], *DATA["deviation"]):
        assert set(one.get("concerns", ())) <= WORDS
    assert {word for kind in DATA["class"] for word in kind["is"]} == WORDS
    assert {one.get("word") for one in DATA["clause"]} == {"must", "should", "may", None}
    ids = {one["id"] for one in DATA["clause"]}
    assert all(one["clause"].split(",")[0].split(":")[0] in ids for one in DATA["deviation"])


@pytest.mark.parametrize("words", [("client",), ("server",)])
@pytest.mark.parametrize("is_regular", [False, True])
def test_no_claim_is_lost_on_a_serial_line(words: tuple[str, ...], is_regular: bool) -> None:
    """Every must of part 2 is met: what breaks one has to say so here."""
    wanted = {*words, "regular"} if is_regular else set(words)
    (kind,) = [one for one in DATA["class"] if set(one["is"]) == wanted and one["letters"] == "AS"]
    (claim,) = [one for one in MODULE.claims(DATA) if one.name == kind["name"]]
    assert claim.musts == ()

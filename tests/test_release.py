"""The release: version and changes agree, checksums find what is wrong, and nothing publishes without a person."""

import importlib.util
import io
import re
from pathlib import Path
from types import ModuleType

import pytest

import busway

ROOT = Path(__file__).resolve().parents[1]


def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("release_script", ROOT / "scripts" / "release.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


RELEASE = script()


def test_the_newest_section_of_the_changes_is_of_this_version() -> None:
    version, _ = RELEASE.newest_section((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    assert version == busway.__version__


@pytest.mark.parametrize(
    ("heading", "found"),
    [("## 0.2.0 (2026-12-01)", ("0.2.0", "2026-12-01")), ("## 0.2.0 (not released)", ("0.2.0", ""))],
)
def test_a_section_without_a_date_is_not_released(heading: str, found: tuple[str, str]) -> None:
    assert RELEASE.newest_section(f"# Changes\n\n{heading}\n\n## 0.1.0 (2026-01-01)\n") == found


def test_checksums_name_what_was_changed_added_or_lost(tmp_path: Path) -> None:
    assert list(RELEASE.wrong_sums(tmp_path)) == ["SHA256SUMS"]
    for name in ("a.whl", "b.tar.gz", "c.json"):
        (tmp_path / name).write_text(name)
    RELEASE.write_sums(tmp_path)
    assert list(RELEASE.wrong_sums(tmp_path)) == []
    (tmp_path / "a.whl").write_text("another")
    (tmp_path / "b.tar.gz").unlink()
    (tmp_path / "d.whl").write_text("more")
    assert list(RELEASE.wrong_sums(tmp_path)) == ["a.whl", "b.tar.gz", "d.whl"]


@pytest.mark.parametrize(
    ("date", "reason"), [("2026-12-01", "only a person at a terminal"), ("not released", "no date")]
)
def test_nothing_is_published_without_a_date_and_a_person(
    tmp_path: Path, date: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "CHANGELOG.md").write_text(f"## 0.2.0 ({date})\n", encoding="utf-8")
    dist = tmp_path / "dist"
    dist.mkdir()
    (dist / "busway-0.2.0-py3-none-any.whl").write_text("x")
    RELEASE.write_sums(dist)
    monkeypatch.setattr(RELEASE, "ROOT", tmp_path)
    monkeypatch.setattr(RELEASE, "DIST", dist)
    monkeypatch.setattr("sys.stdin", io.StringIO("0.2.0\n"))
    with pytest.raises(RELEASE.NoRelease, match=reason):
        RELEASE.publish()


def test_every_extra_for_users_is_tried() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    section = text.partition("[project.optional-dependencies]\n")[2].partition("\n[")[0]
    assert set(RELEASE.extras()) == set(re.findall(r"^(\w+) = ", section, re.MULTILINE)) - {"dev"}

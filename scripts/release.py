"""Makes the files of a release in ``dist``: sdist, wheel, SBOM and checksums; ``--publish`` uploads them.

Knows git, the build, and pip; knows nothing of what the package does. `make release` and `make publish` run it in an
environment with the extra ``release``.

1. What is built is the last commit, never the working tree; a tree with changes is refused.
2. It is built twice, in two folders, with the time of the commit: two builds that differ are no release.
3. Each extra is installed alone, from the wheel, on each Python that is here (3.11 to 3.13), and imported there.
   ``--quick`` leaves that out.
4. Only a person publishes: ``--publish`` wants a terminal, a dated section of CHANGELOG.md, files whose checksums are
   right, and the version typed in.
"""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
DIST: Final = ROOT / "dist"
SUMS: Final = "SHA256SUMS"
PYTHONS: Final = ("3.11", "3.12", "3.13")
NOT_FOR_USERS: Final = {"dev"}
LIMIT: Final = 900
"""Seconds for one command; pip may have to fetch much."""


class NoRelease(Exception):
    """Why there is no release."""


def main(arguments: list[str]) -> int:
    """Make the files, or publish them; exit code 1 with the reason where that is not possible."""
    try:
        if "--publish" in arguments:
            publish()
        else:
            make(quick="--quick" in arguments)
    except NoRelease as reason:
        sys.stderr.write(f"no release: {reason}\n")
        return 1
    return 0


def make(*, quick: bool) -> None:
    """Build, check, describe."""
    version, date = newest_section((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    written = re.search(r'__version__ = "(.+)"', (ROOT / "src/busway/version.py").read_text(encoding="utf-8"))
    if written is None or written[1] != version:
        raise NoRelease(f"src/busway/version.py and the newest section of CHANGELOG.md ({version}) differ")
    if run("git", "status", "--porcelain"):
        raise NoRelease("the working tree has changes that are not committed")
    with tempfile.TemporaryDirectory() as name:
        first, second = (built(Path(name) / place) for place in ("first", "second/deeper"))
        for file in first:
            if checksum(file) != checksum(next(other for other in second if other.name == file.name)):
                raise NoRelease(f"two builds of {file.name} differ")
        shutil.rmtree(DIST, ignore_errors=True)
        DIST.mkdir()
        for file in first:
            shutil.copy(file, DIST)
    (wheel,) = DIST.glob("*.whl")
    run(program("twine"), "check", "--strict", *map(str, sorted(DIST.iterdir())))
    say("two builds are equal, and twine has nothing to say")
    for python in PYTHONS[:0] if quick else PYTHONS:
        try_extras(wheel, python)
    describe(wheel, DIST / f"busway-{version}.cdx.json")
    write_sums(DIST)
    say(f"dist has {', '.join(sorted(file.name for file in DIST.iterdir()))}")
    if not date:
        say("it cannot be published: CHANGELOG.md gives the version no date")


def newest_section(changes: str) -> tuple[str, str]:
    """Version and date of the newest section of CHANGELOG.md; the date is empty where there is none."""
    found = re.search(r"^## (\S+) \((?:(\d{4}-\d\d-\d\d)|[^)]*)\)$", changes, re.MULTILINE)
    if found is None:
        raise NoRelease("CHANGELOG.md has no section of a version")
    return found[1], found[2] or ""


def built(folder: Path) -> list[Path]:
    """Sdist and wheel of the last commit, built in a folder of their own."""
    source, target = folder / "source", folder / "dist"
    source.mkdir(parents=True)
    archive = folder / "source.tar"
    run("git", "archive", "--output", str(archive), "HEAD")
    with tarfile.open(archive) as tar:
        tar.extractall(source, filter="data")
    epoch = run("git", "log", "-1", "--format=%ct")
    command = (sys.executable, "-m", "build", "--no-isolation", "--outdir", str(target), str(source))
    run(*command, SOURCE_DATE_EPOCH=epoch)
    return sorted(target.iterdir())


def try_extras(wheel: Path, python: str) -> None:
    """Install each extra alone on one Python."""
    interpreter = run(str(ROOT / "scripts/find-python"), python, fails=True)
    if not interpreter:
        say(f"Python {python} is not here: nothing was installed on it")
        return
    for extra in ("", *extras()):
        with environment(interpreter, f"{wheel}[{extra}]" if extra else str(wheel)) as inside:
            run(inside, "-m", "pip", "check")
            run(inside, "-c", "import busway; busway.connect; busway.serve")
        say(f"Python {python}: {extra or 'no extra'} installed")


def extras() -> list[str]:
    """The extras that users install."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [name for name in project["optional-dependencies"] if name not in NOT_FOR_USERS]


class environment:  # noqa: N801 - used as a function
    """A new virtual environment with one requirement; gives its interpreter, and removes all afterwards."""

    def __init__(self, interpreter: str, wanted: str) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._made = (interpreter, wanted)

    def __enter__(self) -> str:
        interpreter, wanted = self._made
        run(interpreter, "-m", "venv", self._folder.name)
        inside = str(Path(self._folder.name) / "bin" / "python")
        run(inside, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", wanted)
        return inside

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()


def describe(wheel: Path, target: Path) -> None:
    """Write the SBOM (CycloneDX) of the wheel with all extras, as pip resolves them here."""
    with environment(sys.executable, f"{wheel}[all]") as inside:
        command = (program("cyclonedx-py"), "environment", "--output-reproducible", "--of", "JSON", "-o", str(target))
        run(*command, inside)
    parts = json.loads(target.read_text(encoding="utf-8"))["components"]
    if "busway" not in {part["name"] for part in parts}:
        raise NoRelease("the SBOM does not name busway")
    say(f"the SBOM names {len(parts)} packages")


def write_sums(folder: Path) -> None:
    """Write the checksums of all files of a folder, as ``sha256sum --check`` reads them."""
    files = sorted(file for file in folder.iterdir() if file.name != SUMS)
    (folder / SUMS).write_text("".join(f"{checksum(file)}  {file.name}\n" for file in files), encoding="utf-8")


def wrong_sums(folder: Path) -> Iterator[str]:
    """The files that are not what their checksums say, or have none."""
    sums = folder / SUMS
    if not sums.exists():
        yield SUMS
        return
    given = {name: value for value, name in (line.split("  ") for line in sums.read_text("utf-8").splitlines())}
    names = {file.name for file in folder.iterdir()} - {SUMS}
    for name in sorted(names | set(given)):
        if name not in names or name not in given or checksum(folder / name) != given[name]:
            yield name


def checksum(file: Path) -> str:
    """The SHA-256 of a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def publish() -> None:
    """Upload what `make` has made, after a person has typed its version."""
    version, date = newest_section((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    if not date:
        raise NoRelease(f"CHANGELOG.md gives {version} no date")
    if wrong := list(wrong_sums(DIST)):
        raise NoRelease(f"not as their checksums say: {', '.join(wrong)}; run make release")
    files = sorted(str(file) for kind in ("*.whl", "*.tar.gz") for file in DIST.glob(kind))
    if not all(f"-{version}" in Path(file).name for file in files):
        raise NoRelease(f"dist has another version than {version}; run make release")
    if not sys.stdin.isatty():
        raise NoRelease("only a person at a terminal publishes")
    if input(f"Type the version to upload {', '.join(Path(file).name for file in files)}: ") != version:
        raise NoRelease("nothing was uploaded")
    attestations = sorted(str(file) for file in DIST.glob("*.publish.attestation"))
    subprocess.run(
        [program("twine"), "upload", *(["--attestations"] if attestations else []), *files, *attestations], check=True
    )


def program(name: str) -> str:
    """A program of this environment."""
    return str(Path(sys.executable).with_name(name))


def run(*command: str, fails: bool = False, **settings: str) -> str:
    """What a command prints. A failure is no release, with the command's output, unless it may fail."""
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=os.environ | settings,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT,
    )
    if done.returncode and not fails:
        raise NoRelease(f"{' '.join(command)}\n{done.stdout}{done.stderr}")
    return done.stdout.strip()


def say(text: str) -> None:
    """One line of progress."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

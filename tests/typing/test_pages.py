"""Every block of Python in the documentation passes ``mypy --strict`` and pyright, as a reader who copies it wants.

1. The ``python`` blocks of a page are one program, as `tests/docs` runs them; one that serves for ever is another.
2. A ``py`` block that begins with a file name in a comment is that file, which the next blocks may import.
3. Any other ``py`` block is a sketch: it stands in a coroutine, with the names of `SKETCHED` as they are.
"""

import re
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest
from type_checkers import errors_of_pyright

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
SKETCHED = """
import busway

device: busway.Device
devices: dict[int, busway.Device]
certificates: busway.TlsParameters
policy: busway.Policy
"""
WRONG = """
```python
import busway

busway.connect("tcp://127.0.0.1", timout=1)
```
```py
busway.serve(units={1: 7})
```
"""


def programs_of(page: Path, root: Path) -> dict[str, str]:
    """The programs of a page, by file name."""
    found = re.findall(r"^```(python|py)\n(.*?)^```$", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    name = re.sub(r"\W", "_", str(page.relative_to(root).with_suffix("")))
    servers = [block for kind, block in found if kind == "python" and "serve_forever(" in block]
    rest = [block for kind, block in found if kind == "python" and block not in servers]
    programs = {f"{name}_server_{number}.py": block for number, block in enumerate(servers)}
    if rest:
        programs[f"{name}.py"] = "\n".join(rest)
    for number, block in enumerate(block for kind, block in found if kind == "py"):
        file = re.match(r"# (\w+\.py)\n", block)
        if file:
            programs[file[1]] = block
        else:
            programs[f"{name}_sketch_{number}.py"] = (
                f"{SKETCHED}\nasync def sketch() -> None:\n{textwrap.indent(block, '    ')}"
            )
    return programs


def refused_by_mypy(folder: Path, programs: list[str]) -> list[str]:
    """What mypy says of these programs, line by line."""
    words = [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", "--hide-error-context", "--config-file="]
    done = subprocess.run(
        [*words, f"--cache-dir={ROOT / '.mypy_cache' / 'pages'}", *programs],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=110,
    )
    assert done.returncode in (0, 1), done.stdout + done.stderr
    return done.stdout.splitlines()


def refused_by_pyright(folder: Path, programs: list[str]) -> list[str]:
    """What pyright says of these programs, in the form of mypy."""
    told = errors_of_pyright([folder / name for name in programs], cwd=folder)
    return [f"{Path(one['file']).name}:{one['range']['start']['line'] + 1}: error: {one['message']}" for one in told]


@pytest.mark.parametrize("refused", [refused_by_mypy, refused_by_pyright])
def test_every_block_of_python_in_the_documentation_passes(
    tmp_path: Path, refused: Callable[[Path, list[str]], list[str]]
) -> None:
    wrong = tmp_path / "wrong.md"  # in the same run: a checker needs most of its time for busway itself
    wrong.write_text(WRONG, encoding="utf-8")
    pages = {name: text for page in PAGES for name, text in programs_of(page, ROOT).items()}
    assert len(pages) >= 20
    programs = pages | programs_of(wrong, tmp_path)
    for name, text in programs.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    lines = refused(tmp_path, list(programs))
    assert [line for line in lines if not line.startswith("wrong")] == []
    assert any(line.startswith("wrong.py:3: error") and "timout" in line for line in lines), lines
    assert any(line.startswith("wrong_sketch_0.py") and "int" in line for line in lines), lines

"""``busway simulate --api``: the control API and its page beside the simulation."""

import json
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from program import Busway

from busway.apps.simulator.includes import load_declaration
from busway.apps.simulator.simulation import Simulation
from busway.cli.simulate import _page
from busway.errors import ConfigError

FILE = """\
listen = ["tcp://127.0.0.1:0"]

[[unit]]
unit = 3

[[unit.point]]
name = "level"
address = "4x1"
"""
TOKEN = "a-token-that-a-person-chose"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "tank.toml"
    path.write_text(FILE)
    return path


def ask(url: str, token: str = "") -> dict[str, object]:
    request = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"} if token else {})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return dict(json.loads(answer.read()))


def test_it_says_where_the_page_is_and_answers_there(file: Path) -> None:
    with Busway("simulate", str(file), "--api", "127.0.0.1:0") as program:
        url = program.wait_for("control API and page on").rpartition(" ")[2].strip()
        assert ask(f"{url}api/simulation")["name"] == "tank"
        program.stop()
        assert program.process.returncode == 0


def test_a_token_of_a_file_is_needed_then(file: Path, tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text(f"{TOKEN}\n")
    with Busway("simulate", str(file), "--api", "127.0.0.1:0", "--api-token", str(token)) as program:
        line = program.wait_for("control API and page on")
        url = line.rpartition(" ")[2].strip()
        assert "token" not in line
        with pytest.raises(urllib.error.HTTPError) as refused:
            ask(f"{url}api/simulation")
        assert refused.value.code == 401
        refused.value.close()
        assert ask(f"{url}api/simulation", TOKEN)["units"] == 1
        out, said = program.stop()
        assert TOKEN not in out + said


def test_without_the_extra_it_says_what_to_install(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    for module in ("hosting", "simulation_page"):
        monkeypatch.delitem(sys.modules, f"busway.apps.web.{module}", raising=False)
    with pytest.raises(ConfigError, match=r"busway\[web\]"):
        _page(Simulation(load_declaration(file)), "127.0.0.1:0", None, str(file))

"""``busway fleet``: a file is applied, a collector runs by it, is shown and drained; wrong use is one sentence."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from foreign_servers import nats_server
from program import Busway

PLANT = """\
[collector]
store = "data"
page = "off"
[poll_class]
all.period = 0.1
[[link]]
name = "a"
url = "{url}"
[[device]]
name = "meter-7"
link = "a"
unit = 1
profile = "meter"
"""


def written(folder: Path, url: str = "tcp://127.0.0.1:9") -> str:
    (folder / "meter.toml").write_text(
        '[[unit]]\n[[unit.point]]\nname = "level"\naddress = "4x1"\ntype = "uint16"\npoll_class = "all"\n'
    )
    text = PLANT.format(url=url).replace('profile = "meter"', 'profile = "meter.toml"')
    (folder / "plant.toml").write_text(text)
    return str(folder / "plant.toml")


def test_a_collector_runs_by_what_was_applied_and_is_shown(run: Callable[..., Any], tmp_path: Path) -> None:
    at = ("--coordinator", f"local:{tmp_path}/zone")
    file = written(tmp_path)
    assert "no configuration" in run("fleet", "status", *at).out
    missing = run("fleet", "run", *at)
    assert (missing.code, "busway fleet apply FILE" in missing.err) == (2, True)
    assert run("fleet", "apply", file, *at).out.endswith("with revision 1\n")
    with Busway("fleet", "run", *at, "--name", "west", "--store", str(tmp_path / "west")) as west:
        west.wait_for("west collects into")
        polls, shown = [("west", "polls", 1)], []
        while shown != polls:  # it writes its entry after those of others; a busy machine may renew it late
            assert west.process.poll() is None
            status = json.loads(run("fleet", "status", "--json", *at).out)
            shown = [(each["name"], each["state"], each["revision"]) for each in status["collectors"]]
        refused = run("fleet", "restore", *at)
        assert (refused.code, "stop all collectors first: west" in refused.err) == (2, True)
        assert "told to hand on" in run("fleet", "drain", "west", *at).out
        west.stop()
    status = json.loads(run("fleet", "status", "--json", *at).out)
    assert status["collectors"][0]["state"] in ("ended", "silent"), "silent where a busy machine took too long to end"
    assert (status["collectors"][0]["commits_behind"], status["collectors"][0]["problem"]) == (0, "")
    assert re.search(r"^west .* 0 +1$", run("fleet", "status", *at).out, re.MULTILINE), "no commit behind, revision 1"
    assert all(each["hole"] is None for each in status["shards"].values())
    with Busway("fleet", "run", *at, "--name", "east", "--store", str(tmp_path / "east")) as east:
        east.wait_for("east collects into")
        holes: list[dict[str, Any]] = []
        while not holes:
            assert east.process.poll() is None
            shards = json.loads(run("fleet", "status", "--json", *at).out)["shards"].values()
            holes = [each["hole"] for each in shards if each["owner"] == "east" and each["hole"]]
        assert all(each["before"] == "west" and each["end"] > each["begin"] for each in holes)
        shown = run("fleet", "status", *at).out
        assert re.search(
            r"^\w+ +east +\S+ +[-\d]+ [:\d]+\S*, \d+\.\d s +west (gave it back|fell silent)$", shown, re.M
        ), shown
        east.stop()


def test_leases_hold_for_as_long_as_an_operator_says_while_no_collector_runs(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    at = ("--coordinator", f"local:{tmp_path}/zone")
    file = written(tmp_path)
    plant = Path(file)
    plant.write_text(plant.read_text().replace('name = "a"', 'name = "a"\ngateway_wait = 12', 1))
    refused = run("fleet", "apply", file, *at)
    assert (refused.code, "12 s of it in a gateway" in refused.err) == (2, True)
    ttl = re.search(r"busway fleet apply --ttl (\d+s)", refused.err)
    assert ttl is not None
    first = run("fleet", "apply", file, "--ttl", ttl[1], "--shards", "8", *at)
    assert first.out.startswith(f"leases of the zone hold for {ttl[1][:-1]} s\n"), first.err
    with Busway("fleet", "run", *at, "--shards", "8", "--name", "west", "--store", str(tmp_path / "west")) as west:
        west.wait_for("west collects into")
        while not json.loads(run("fleet", "status", "--json", *at).out)["collectors"]:
            assert west.process.poll() is None
        other = run("fleet", "apply", file, "--ttl", "60s", *at)
        assert (other.code, other.err) == (
            2,
            f"busway: --ttl: leases of the zone hold for {ttl[1][:-1]} s, the same for all; stop all collectors first: "
            "west still run\n",
        )
        assert run("fleet", "apply", file, "--ttl", ttl[1], *at).code == 0, "nothing changes"
        west.stop()
    assert "leases of the zone hold for 60 s\n" in run("fleet", "apply", file, "--ttl", "60s", *at).out
    again = run("fleet", "apply", file, *at)
    assert again.code == 0, "the zone has the time until another one is given"
    with Busway("fleet", "run", *at, "--shards", "8", "--name", "east", "--store", str(tmp_path / "east")) as east:
        east.wait_for("east collects into")
        shards: dict[str, Any] = {}
        while not shards:
            assert east.process.poll() is None
            shards = {
                shard: each
                for shard, each in json.loads(run("fleet", "status", "--json", *at).out)["shards"].items()
                if each["owner"] == "east"
            }
        east.stop()


def test_restore_raises_the_generation_and_each_time_further(run: Callable[..., Any], tmp_path: Path) -> None:
    at = ("--coordinator", f"local:{tmp_path}/zone")
    first, second = (int(run("fleet", "restore", *at).out.split()[-1]) for _ in range(2))
    assert 1_700_000_000 < first < second


def test_a_broken_file_is_refused_with_its_line(run: Callable[..., Any], tmp_path: Path) -> None:
    file = written(tmp_path, "nonsense://x")
    result = run("fleet", "apply", file, "--coordinator", f"local:{tmp_path}/zone")
    assert result.code == 2
    assert "plant.toml:8: " in result.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["status"], "--coordinator"),
        (["run", "--ttl", "30s", "--coordinator", "local:x"], "--ttl: is for apply"),
        (["apply", "x.toml", "--ttl", "301s", "--coordinator", "local:x"], "--ttl: a time of 3…300 s is needed"),
        (["drain", "--coordinator", "local:x"], "drain NAME"),
        (["status", "--undo", "--coordinator", "local:x"], "--undo: is for drain"),
        (["status", "--name", "a", "--coordinator", "local:x"], "--name: is for run"),
        (["status", "--coordinator", "etcd://x"], "local:FOLDER"),
        (["status", "--coordinator", "local:x", "--zone", "a b"], "zone 'a b'"),
        (["apply", "x.toml", "--coordinator", "local:x", "--zone", "a" * 55], "up to 54 characters"),
    ],
)
def test_wrong_use_is_one_sentence(
    run: Callable[..., Any], words: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("BUSWAY_FLEET", raising=False)
    result = run("fleet", *words)
    assert result.code == 2
    assert said in result.err


@pytest.mark.real_time
def test_a_server_that_does_not_sync_is_told_by_name_when_a_fleet_begins(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("nats")
    file = written(tmp_path)
    with nats_server(tmp_path, 'server_name: "main"') as server:
        at = ("--coordinator", f"nats://127.0.0.1:{server.port}", "--zone", "hall")
        applied = run("fleet", "apply", file, *at)
        assert applied.code == 0
        assert "warning: nats-server main (2." in applied.err
        (shown,) = json.loads(run("fleet", "status", "--json", *at).out)["servers"]
        assert (shown["name"], shown["replicas"]) == ("main", 1)
        assert "nats-server main (2." in run("fleet", "status", *at).out
    assert "warning" not in run("fleet", "apply", file, "--coordinator", f"local:{tmp_path}/zone").err


def test_collect_imports_nothing_of_the_fleet() -> None:
    program = (
        "import sys; import busway.cli.collect, busway.apps.collector.collector; "
        "print([name for name in sys.modules if 'fleet' in name])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"

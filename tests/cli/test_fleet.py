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


SLOW = """\
[[link]]
name = "slow"
url = "tcp://127.0.0.1:9"
[[device]]
name = "meter-8"
link = "slow"
unit = 2
line_baud = 1200
profile = "meter.toml"
[[link]]"""


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


def test_a_collector_warns_of_poll_periods_that_a_link_of_the_zone_cannot_keep(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    at = ("--coordinator", f"local:{tmp_path}/zone")
    plant = Path(written(tmp_path))
    plant.write_text(plant.read_text().replace("all.period = 0.1", "all.period = 0.01").replace("[[link]]", SLOW))
    assert run("fleet", "apply", str(plant), *at).code == 0
    with Busway("fleet", "run", *at, "--status-every", "0.1s", "--store", str(tmp_path / "west")) as west:
        first = west.wait_for("warning: link slow would need")
        plant.write_text(plant.read_text().replace("line_baud = 1200\n", "line_baud = 300\n"))
        assert run("fleet", "apply", str(plant), *at).code == 0
        assert west.wait_for("warning: link slow would need") != first
        west.stop()


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


def test_restore_warns_where_leases_are_lost_that_say_what_is_in_maintenance(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    at = ("--coordinator", f"local:{tmp_path}/zone")
    lost = run("fleet", "restore", *at)
    assert lost.code == 0
    assert "begin maintenance again after the start" in lost.err
    assert run("fleet", "apply", written(tmp_path), *at).code == 0
    with Busway("fleet", "run", *at, "--name", "west", "--store", str(tmp_path / "west")) as west:
        west.wait_for("west collects into")
        while not json.loads(run("fleet", "status", "--json", *at).out)["shards"]:
            assert west.process.poll() is None
        west.stop()
    while "still run" in (kept := run("fleet", "restore", *at)).err:
        assert kept.code == 2  # its last entry counts for some seconds where a busy machine took too long to end
    assert (kept.code, kept.err) == (0, "")


def test_a_broken_file_is_refused_with_its_line(run: Callable[..., Any], tmp_path: Path) -> None:
    file = written(tmp_path, "nonsense://x")
    result = run("fleet", "apply", file, "--coordinator", f"local:{tmp_path}/zone")
    assert result.code == 2
    assert "plant.toml:8: " in result.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "--ttl", "30s", "--coordinator", "local:x"], "--ttl: is for apply"),
        (["apply", "x.toml", "--ttl", "301s", "--coordinator", "local:x"], "--ttl: a time of 3…300 s is needed"),
        (["drain", "--coordinator", "local:x"], "drain: wants NAME, not nothing"),
        (["status", "west", "--coordinator", "local:x"], "status: wants nothing, not west"),
        (["begin", "--coordinator", "local:x"], "ACTION: must be demo, apply, run,"),
        (["status", "--undo", "--coordinator", "local:x"], "--undo: is for drain"),
        (["status", "--name", "a", "--coordinator", "local:x"], "--name: is for run"),
        (["status", "--within", "30s", "--coordinator", "local:x"], "--within: is for write; status does not take it"),
        (["status", "--shards", "256", "--coordinator", "local:x"], "--shards: is for apply, run; status does not"),
        (["status", "--status-every", "1s", "--coordinator", "local:x"], "--status-every: is for run, sink; status"),
        (["drain", "west", "--json", "--coordinator", "local:x"], "--json: is for run, sink, write, status; drain"),
        (["restore", "--system-credentials", "x", "--coordinator", "local:x"], "; restore does not take it"),
        (["run", "--domain", "yard", "--coordinator", "local:x"], "drain, restore; run does not take it"),
        (
            ["demo", "--coordinator", "local:x"],
            "--coordinator: is for apply, run, sink, write, status, drain, restore;",
        ),
        (["demo", "--undo"], "--undo: is for drain; demo does not take it"),
        (["server-config", "hall", "--key", "k"], "--key: is for write; server-config does not take it"),
        (["status", "--coordinator", "etcd://x"], "local:FOLDER"),
        (["status", "--coordinator", "local:x", "--zone", "a b"], "zone 'a b'"),
        (["apply", "x.toml", "--coordinator", "local:x", "--zone", "a" * 55], "up to 54 characters"),
        (["status", "--coordinator", "local:x", "--zone", ""], "zone ''"),  # of a variable that is not set
        (["status", "--coordinator", "local:x", "--replicas", ""], "--replicas: "),
        (["run", "--coordinator", "local:x", "--shards", ""], "--shards: "),
        (["run", "--coordinator", "local:x", "--status-every", ""], "--status-every: "),
        (["write", "link-0", "count", "1", "--coordinator", "local:x", "--within", ""], "--within: "),
        (["demo", "--for", ""], "--for: "),
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


@pytest.fixture
def at_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a user whose environment names no coordinator."""
    for name in ("BUSWAY_FLEET", "BUSWAY_FLEET_CREDENTIALS", "BUSWAY_FLEET_CA", "BUSWAY_FLEET_PASSWORD"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path / "home" / ".local" / "state" / "busway" / "fleet"


def test_without_a_coordinator_all_actions_use_one_folder_of_the_user_and_say_so(
    run: Callable[..., Any], tmp_path: Path, at_home: Path
) -> None:
    sentence = f"busway: the coordinator is local:{at_home}, for collectors of this machine alone; "
    applied = run("fleet", "apply", written(tmp_path))
    assert (applied.code, applied.err.startswith(sentence)) == (0, True), applied.err
    with Busway("fleet", "run", "--name", "west", "--store", str(tmp_path / "west")) as west:
        assert sentence in west.wait_for("the coordinator is")
        west.wait_for("west collects into")
        states: list[str] = []
        while states != ["polls"]:
            assert west.process.poll() is None
            shown = run("fleet", "status", "--json")
            assert sentence in shown.err
            states = [each["state"] for each in json.loads(shown.out)["collectors"]]
        drained = run("fleet", "drain", "west")
        assert ("told to hand on" in drained.out, sentence in drained.err) == (True, True)
        assert "west still run" in run("fleet", "restore").err
        west.stop()
    assert (at_home / "plant.fleet").exists()
    named = run("fleet", "status", "--json", "--coordinator", f"local:{at_home}")
    assert (json.loads(named.out)["revision"], named.err) == (1, ""), "the same table, by its name"
    assert run("fleet", "status", "--quiet").err == ""


def test_the_folder_is_that_of_the_environment(
    run: Callable[..., Any], tmp_path: Path, at_home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert run("fleet", "restore").code == 0
    assert (tmp_path / "state" / "busway" / "fleet" / "plant.fleet").exists()
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    assert run("fleet", "restore").code == 0
    assert (at_home / "plant.fleet").exists(), "a relative path is not valid"
    monkeypatch.setenv("BUSWAY_FLEET", f"local:{tmp_path}/named")
    (said,) = run("fleet", "restore", "--zone", "hall").err.splitlines()
    assert "has no leases" in said, "and no word about a folder that was chosen"
    assert (tmp_path / "named" / "hall.fleet").exists()


@pytest.mark.parametrize(
    ("words", "name", "needed"),
    [
        (["run", "--stream"], "--stream", "nats://host:4222;"),
        (["sink", "broker"], "sink", "nats://host:4222;"),
        (["write", "meter-7", "setpoint", "20"], "write", "nats://host:4222;"),
        (["status", "--credentials", "x.nk"], "--credentials", "nats://host:4222;"),
        (["status", "--system-credentials", "x.nk"], "--system-credentials", "nats://host:4222;"),
        (["apply", "x.toml", "--replicas", "3"], "--replicas", "nats://host:4222;"),
        (["drain", "west", "--domain", "yard"], "--domain", "nats://host:4222;"),
        (["run", "--user", "west"], "--user", "nats://host:4222 or postgresql://"),
        (["run", "--ca", "ca.pem"], "--ca", "nats://host:4222 or postgresql://"),
    ],
)
def test_what_needs_a_server_is_refused_without_one(
    run: Callable[..., Any], at_home: Path, words: list[str], name: str, needed: str
) -> None:
    refused = run("fleet", *words)
    assert refused.code == 2
    assert refused.err.startswith(f"busway: {name}: needs --coordinator {needed}"), refused.err
    assert refused.err.endswith(f"share the folder {at_home}\n"), refused.err
    assert not at_home.exists()


def test_a_user_without_a_home_has_to_name_a_coordinator(
    run: Callable[..., Any], at_home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "none")
    refused = run("fleet", "status")
    assert (refused.code, "--coordinator: is needed, as this user has no home" in refused.err) == (2, True)


@pytest.mark.parametrize("name", ["BUSWAY_FLEET_CREDENTIALS", "BUSWAY_FLEET_CA", "BUSWAY_FLEET_PASSWORD"])
def test_a_machine_that_lacks_only_the_name_of_its_server_starts_no_zone_of_its_own(
    run: Callable[..., Any], at_home: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, "x")
    refused = run("fleet", "run")
    assert (refused.code, refused.err.startswith(f"busway: {name}: needs --coordinator nats://host:4222")) == (2, True)
    assert not at_home.exists()

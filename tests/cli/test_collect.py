"""``busway collect``: polls until it is stopped, shows its plan without traffic, reads its file again."""

import json
import os
import signal
import socket
from pathlib import Path
from urllib.request import urlopen

import pytest
from program import Busway
from waiting import wait_until

import busway
from busway.apps.collector.collector import write_learnt
from busway.apps.collector.knowledge import DeviceKnowledge, Knowledge, LearntHole
from busway.codes import Table

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
    file = folder / "plant.toml"
    file.write_text(PLANT.replace("{url}", url))
    return str(file)


def is_stored(folder: Path, device: str) -> bool:
    """Whether a sample of this device is in the store."""
    store = busway.Store(folder / "data")
    return any(point.device == device for point in store.points()) and len(store.read(device)) > 0


def device() -> busway.Device:
    return busway.Device(holding_registers=100, input_registers=200)


def test_the_plan_is_shown_without_traffic(run, tmp_path: Path) -> None:
    result = run("collect", "plan", written(tmp_path))
    assert result.code == 0
    assert "meter-7  all    3x1    34     17" in result.out
    assert "would learn what a read and a register cost" in result.out
    assert "link a: " in result.out
    assert not (tmp_path / "data").exists()


def test_the_plan_as_json_has_a_line_for_each_read_and_link(run, tmp_path: Path) -> None:
    lines = [json.loads(line) for line in run("collect", "plan", written(tmp_path), "--json").out.splitlines()]
    assert lines[0]["first"] == "3x1"
    assert lines[-1]["link"] == "a"
    assert lines[-1]["problems"] == []


def test_a_plan_that_does_not_fit_ends_with_another_code_and_names_the_class(run, tmp_path: Path) -> None:
    file = Path(written(tmp_path))
    file.write_text(file.read_text().replace("0.1", "0.01"))
    result = run("collect", "plan", str(file))
    assert result.code == 4
    assert "give class all a period of" in result.out or "class all has a period of 0.01 s" in result.out


def test_a_file_with_errors_names_all_of_them(run, tmp_path: Path) -> None:
    file = Path(written(tmp_path))
    file.write_text(file.read_text().replace("period", "perod").replace('link = "a"', 'lnk = "a"'))
    result = run("collect", str(file))
    assert result.code == 2
    assert "plant.toml:5: poll_class.all.perod" in result.err
    assert "plant.toml:11: device[0].lnk" in result.err


@pytest.mark.parametrize("words", [("plans", "x"), ("plan", "x", "y")])
def test_other_words_are_refused(run, words: tuple[str, ...]) -> None:
    assert run("collect", *words).code == 2


def test_what_was_learnt_is_shown_pinned_and_forgotten(run, tmp_path: Path) -> None:
    file = written(tmp_path)
    (tmp_path / "data").mkdir()
    hole = LearntHole(Table.INPUT_REGISTERS, 20, 22, 2)
    write_learnt(tmp_path / "data" / "learnt.json", Knowledge({"meter-7": DeviceKnowledge("meter", "", 0.02, (hole,))}))
    assert "meter-7: input register 20…21: exception 02\n" in run("collect", "learnt", file).out
    assert "(pinned)" in run("collect", "learnt", file, "--pin", "meter-7").out
    assert (
        "meter-7/reactive_power is not read: input registers 20…21 must not be read" in run("collect", "plan", file).out
    )
    assert run("collect", "learnt", file, "--forget", "meter-7").out == ""
    assert run("collect", "learnt", file, "--forget", "meter-9").code == 2
    assert run("collect", file, "--pin", "meter-7").code == 2


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP here")
def test_it_collects_until_it_is_stopped_and_reads_its_file_again(tmp_path: Path) -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device()}) as server:
        file = Path(written(tmp_path, server.endpoints[0]))
        with Busway("collect", str(file), "--status-every", "100ms") as program:
            assert "links 1, devices 1, points 26" in program.wait_for("collects into")
            wait_until(lambda: is_stored(tmp_path, "meter-7"))
            file.write_text(file.read_text().replace("meter-7", "meter-8"))
            program.process.send_signal(signal.SIGHUP)
            assert "link a began anew" in program.wait_for("read again")
            file.write_text(file.read_text().replace("0.1", "none"))
            program.process.send_signal(signal.SIGHUP)
            program.wait_for("nothing was changed")
            wait_until(lambda: is_stored(tmp_path, "meter-8"))
            out, _ = program.stop()
        assert "1 of 1 devices answer" in out


def test_a_second_collector_on_the_store_is_refused_with_the_pid_of_the_first(run, tmp_path: Path) -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device()}) as server:
        file = written(tmp_path, server.endpoints[0])
        with Busway("collect", file) as program:
            program.wait_for("collects into")
            result = run("collect", file)
            assert result.code == 2
            assert str(program.process.pid) in result.err
            assert run("collect", "learnt", file, "--forget", "meter-7").code == 2
            program.stop()
    assert os.path.exists(tmp_path / "data" / "learnt.json")


def test_the_page_is_served_and_its_address_is_said(tmp_path: Path) -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device()}) as server:
        file = Path(written(tmp_path, server.endpoints[0]))
        file.write_text(file.read_text().replace('"off"', '"127.0.0.1:0"'))
        with Busway("collect", str(file)) as program:
            url = program.wait_for("page on").split("page on ")[1].split()[0]
            with urlopen(url + "api/points", timeout=20) as answer:
                assert len(json.load(answer)["points"]) == 26
            program.stop()


def test_without_a_free_port_the_page_is_left_out_and_polling_goes_on(tmp_path: Path) -> None:
    with (
        busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device()}) as server,
        socket.create_server(("127.0.0.1", 0)) as taken,
    ):
        file = Path(written(tmp_path, server.endpoints[0]))
        file.write_text(file.read_text().replace('"off"', f'"127.0.0.1:{taken.getsockname()[1]}"'))
        with Busway("collect", str(file), "--status-every", "100ms") as program:
            assert "no page: " in program.wait_for("no page")
            program.wait_for("collects into")
            out, _ = program.stop()
        assert "of 1 devices answer" in out


def test_the_demo_shows_a_plant_from_its_line_to_the_page_and_ends_by_itself() -> None:
    with Busway("collect", "demo", "--for", "8s") as program:
        said = program.wait_for("page")
        if "page on " in said:  # the port may be taken here
            with urlopen(said.split("page on ")[1].split()[0] + "api/points", timeout=20) as answer:
                points = {each["point"] for each in json.load(answer)["points"]}
            assert {"tank.level", "meter.power", "tank.temperature"} <= points
        out, _ = program.end()
    assert "of 3 devices answer" in out


def test_how_long_the_demo_lasts_is_for_the_demo_alone(run, tmp_path: Path) -> None:
    assert run("collect", written(tmp_path), "--for", "1s").code == 2

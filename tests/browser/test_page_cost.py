"""What a page with 5000 points costs the collector and the browser while each of them changes every second.

The figures are printed: ``pytest -s tests/browser/test_page_cost.py``.
"""

import json
import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from processor_time import slowness
from program import Busway

import busway

POINTS = 5000
SECONDS = 5.0
MOST = 0.10
"""Part of a core that the page may cost."""
PLANT = """\
[collector]
store = "data"
page = "127.0.0.1:0"
[poll_class]
all.period = 1.0
[[link]]
name = "hall"
url = "{url}"
[[device]]
name = "plant"
link = "hall"
unit = 1
profile = "plant.toml"
"""


def cpu_seconds(pid: int) -> float:
    """Seconds of processor that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def used_by(pid: int) -> float:
    """Part of a core that a process uses now."""
    begun, before = time.monotonic(), cpu_seconds(pid)
    time.sleep(SECONDS)
    return (cpu_seconds(pid) - before) / (time.monotonic() - begun)


def keep_changing(device: busway.Device, ended: threading.Event) -> None:
    """Give each register another value twice a second."""
    turn = 0
    while not ended.wait(0.5):
        turn += 1
        device.holding_registers[0:POINTS] = [(place * 7 + turn * 13) % 60_000 for place in range(POINTS)]


@pytest.mark.alone
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="the processor time of a process is read from /proc")
def test_a_page_with_5000_points_costs_at_most_a_tenth_of_a_core(tmp_path: Path, new_page: Any) -> None:
    before_work = slowness()
    device = busway.Device(holding_registers=POINTS)
    points = "".join(
        f'    {{ name = "p{place}", address = "holding:{place}", scale = 0.1, unit_of_measure = "V" }},\n'
        for place in range(POINTS)
    )
    (tmp_path / "plant.toml").write_text(f"[[unit]]\nunit = 1\npoint = [\n{points}]\n")
    ended = threading.Event()
    changing = threading.Thread(target=keep_changing, args=(device, ended))
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device}) as server:
        file = tmp_path / "collector.toml"
        file.write_text(PLANT.format(url=server.endpoints[0]))
        changing.start()
        try:
            with Busway("collect", str(file)) as program:
                url = program.wait_for("page on ").partition("page on ")[2].split()[0]
                time.sleep(3)
                without = used_by(program.process.pid)
                page = new_page("about:blank")
                received: list[str] = []

                def keep(text: str) -> None:
                    received.append(text)

                page.on("websocket", lambda socket: socket.on("framereceived", keep))
                page.goto(url)
                page.locator("#value-rows [data-quality=good]").first.wait_for()
                session = page.context.new_cdp_session(page)
                session.send("Performance.enable")
                received.clear()
                before = metrics(session)
                shown = used_by(program.process.pid)
                page.wait_for_timeout(1000)  # what was received is handed over
                after = metrics(session)
                page.close()
                program.stop()
        finally:
            ended.set()
            changing.join()
    changes = sum(len(run[1]) for text in received for run in json.loads(text)["changed"])
    assert changes >= POINTS * SECONDS / 2, f"only {changes} changes arrived"
    took = after["Timestamp"] - before["Timestamp"]
    script, tasks = ((after[name] - before[name]) / took for name in ("ScriptDuration", "TaskDuration"))
    print(f"\n{POINTS} points that change each second:")
    print(f"collector: {100 * without:.1f} % of a core without a page, {100 * (shown - without):.1f} % more with one")
    print(f"browser: {100 * script:.1f} % in scripts, {100 * tasks:.1f} % in all on its main thread")
    print(f"stream: {changes / SECONDS:.0f} changes/s in {sum(map(len, received)) / SECONDS / 1000:.0f} kB/s")
    slower = max(before_work, slowness())
    assert shown - without <= MOST * slower
    assert script <= MOST * slower


def metrics(session: Any) -> dict[str, float]:
    return {each["name"]: each["value"] for each in session.send("Performance.getMetrics")["metrics"]}

"""``busway collect demo``: a small plant on a serial line, a gateway in front of it, and a collector with its page.

1. Everything is on loopback and in a temporary folder, which is removed at the end.
2. The demonstration ends after its time, or at Ctrl-C.
"""

import asyncio
from contextlib import AsyncExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from .collect_status import open_demo_page, print_status
from .demo import started_plant
from .output import say
from .signals import on_hangup, stop_event

COLLECTOR_FILE = """\
[collector]
clock = "trusted"
store = "data"
page = "{page}"

[poll_class]
all.period = 0.5

[[link]]
name = "gateway"
url = "{url}"
timeout = 2.0
"""
DEVICE = """
[[device]]
name = "{name}"
link = "gateway"
unit = {unit}
profile = "{name}.toml"
line_baud = {baud}
"""


async def collect_demo(limit: float, page: str) -> None:
    """Run the collector's demonstration until ``limit`` seconds have passed or a signal comes; then print the status.

    Args:
        limit: seconds.
        page: host and port of the collector's page; if the port is taken, a free one is used.
    """
    from ..apps.collector.collector import Collector
    from ..apps.collector.configuration import load_collector

    with stop_event() as stop, on_hangup(stop.set):
        async with AsyncExitStack() as stack:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="busway-demo-")))
            _, url = await started_plant(stack, 0)
            say(f"a plant of three devices on a serial line, behind a gateway on {url}; one of them dies now and then")
            configuration = load_collector(_written(folder, url, page))
            collector = await stack.enter_async_context(Collector(configuration))
            say(f"collects into {configuration.store}, for {limit:g} s or until Ctrl-C")
            await open_demo_page(stack, collector)
            try:
                async with asyncio.timeout(limit):
                    await stop.wait()
            except TimeoutError:
                pass
            print_status(collector, as_json=False)


def _written(folder: Path, url: str, page: str) -> Path:
    """Write the demonstration's collector file and device profiles into a folder; return the path of the file."""
    from ..apps.simulator.demo_plant import PLANT_FILE
    from ..config.files.device import parse_device_file
    from .demo import BAUD

    text = COLLECTOR_FILE.format(page=page, url=url)
    profiles = PLANT_FILE.split("[[unit]]\n")[1:]
    for section, profile in zip(parse_device_file(PLANT_FILE, "plant").unit, profiles, strict=True):
        (folder / f"{section.name}.toml").write_text(f"[[unit]]\n{profile}", encoding="utf-8")
        text += DEVICE.format(name=section.name, unit=section.unit[0], baud=BAUD)
    file = folder / "plant.toml"
    file.write_text(text, encoding="utf-8")
    return file

"""``busway collect``: polls devices and stores their values, until Ctrl-C or SIGTERM.

1. ``plan`` and ``learnt`` send nothing and open no port. ``plan`` ends with code 4 if a link has no time for all its
   reads.
2. What ``plan``, ``learnt`` and ``dashboard`` show goes to stdout, and so does the status: a line about the samples,
   and one for each link, each sink and each device in trouble. Everything else goes to stderr.
3. SIGHUP reads the file again: an invalid file changes nothing, a valid one is applied link by link.
"""

import asyncio
import os
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import typer

from ..errors import ConfigError, ModbusError
from .arguments import JSON, QUIET, VERBOSE, seconds, show_traffic
from .collect_status import open_page, print_status, warn_of_loads
from .exits import ExitCode
from .output import print_aligned, print_json, say, say_problems
from .signals import on_hangup, stop_event

if TYPE_CHECKING:
    from ..apps.collector.collector import Collector
    from ..apps.collector.configuration import CollectorConfiguration

EXAMPLES = """\b
Examples:
  busway collect plant.toml
  busway collect demo
  busway collect dashboard prometheus > plant.json
  busway collect plan plant.toml
  busway collect learnt plant.toml
  busway collect learnt plant.toml --pin meter-7
  busway collect learnt plant.toml --forget meter-7

`dashboard prometheus|postgresql` prints a dashboard for Grafana.
`plan` shows the reads, the load of each link and what it would learn; nothing is sent.
"""

ACTIONS = ("plan", "learnt")
DEMO_PAGE = "127.0.0.1:8503"


def collect(
    words: list[str] = typer.Argument(
        ..., metavar="[plan|learnt] FILE|demo|dashboard KIND", help="A collector file, in TOML."
    ),
    status_every: str = typer.Option("60s", "--status-every", metavar="TIME", help="Print a status this often: 60s."),
    lasts: str | None = typer.Option(None, "--for", metavar="TIME", help="demo: end after this time: 60s."),
    pin: str | None = typer.Option(None, "--pin", metavar="DEVICE", help="learnt: keep what was learnt of a device."),
    forget: str | None = typer.Option(None, "--forget", metavar="DEVICE", help="learnt: learn it anew."),
    as_json: bool = JSON,
    verbose: int = VERBOSE,
    quiet: bool = QUIET,
) -> int:
    """Poll devices and store their values."""
    from ..apps.collector.configuration import load_collector

    if words == ["demo"]:
        return _demo(lasts, verbose)
    if words[0] == "dashboard":
        return _print_dashboard(words[1:])
    action, file = _action_and_file(words)
    if lasts is not None:
        raise ConfigError("is for demo", key="--for")
    if action != "learnt" and (pin or forget):
        raise ConfigError("is for learnt", key="--pin" if pin else "--forget")
    every = seconds(status_every, "--status-every", low=0.1)
    configuration = load_collector(file)
    if action == "plan":
        return _show_plan(configuration, as_json=as_json)
    if action == "learnt":
        return _show_learnt(configuration, pin, forget, as_json=as_json)
    show_traffic(verbose)
    from ..server.loops import run

    run(_collect(configuration, every, as_json=as_json))
    return ExitCode.DONE


def _demo(lasts: str | None, verbose: int) -> int:
    from ..server.loops import run
    from .collect_demo import collect_demo

    limit = seconds("60s" if lasts is None else lasts, "--for", low=0.1)
    show_traffic(verbose)
    run(collect_demo(limit, DEMO_PAGE))
    return ExitCode.DONE


def _print_dashboard(words: list[str]) -> int:
    from ..apps.collector.dashboards import dashboard

    typer.echo(dashboard(" ".join(words)), nl=False)
    return ExitCode.DONE


def _action_and_file(words: list[str]) -> tuple[str, str]:
    if words[0] in ACTIONS and len(words) == 1 and not os.path.exists(words[0]):
        raise ConfigError(f"is missing: busway collect {words[0]} FILE", key="FILE")
    if len(words) == 1 and words[0] != "status":
        return "", words[0]
    if len(words) == 2 and words[0] in ACTIONS:
        return words[0], words[1]
    if words[0] == "status":
        raise ConfigError(
            "a running collector shows its status on its page, which busway status names, and prints it by itself",
            key="status",
        )
    raise ConfigError(f"must be FILE, or {' or '.join(ACTIONS)} and FILE, not {' '.join(words)}", key="FILE")


# Running.


async def _collect(configuration: "CollectorConfiguration", every: float, *, as_json: bool) -> None:
    from ..apps.collector.collector import Collector

    collector, begun = Collector(configuration), asyncio.Event()
    tasks: set[asyncio.Task[None]] = set()

    def read_again() -> None:
        task = asyncio.create_task(_read_again(collector, begun))
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    with stop_event() as stop:
        async with AsyncExitStack() as stack:
            stack.enter_context(on_hangup(read_again))  # first of all: without it a hangup ends the program
            stack.push_async_callback(_cancelled, tasks)
            await stack.enter_async_context(collector)
            begun.set()
            await open_page(stack, collector)
            _say_what_runs(collector)
            while not stop.is_set():
                try:
                    async with asyncio.timeout(every):
                        await stop.wait()
                except TimeoutError:
                    print_status(collector, as_json=as_json)
            await _cancelled(tasks)
            print_status(collector, as_json=as_json)


async def _cancelled(tasks: "set[asyncio.Task[None]]") -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def _say_what_runs(collector: "Collector") -> None:
    configuration = collector.configuration
    points = sum(len(device.points) for device in configuration.devices.values())
    say(
        f"collects into {configuration.store}: links {len(configuration.links)},"
        f" devices {len(configuration.devices)}, points {points}"
    )
    for page in collector.pages:
        say(f"last values for Prometheus on {page}")
    warn_of_loads(collector.configuration, collector.knowledge)


async def _read_again(collector: "Collector", begun: asyncio.Event) -> None:
    await begun.wait()
    try:
        done = await collector.read_again()
    except ModbusError as error:
        say_problems("read again, nothing was changed:", str(error))
    else:
        say(f"read again: {'; '.join(done)}")
        warn_of_loads(collector.configuration, collector.knowledge)


# What would be done.


def _show_plan(configuration: "CollectorConfiguration", *, as_json: bool) -> int:
    from ..apps.collector.learnt_file import LearntFile
    from ..apps.collector.preview import preview

    shown = preview(configuration, LearntFile(configuration.learnt_path).read())
    if as_json:
        for read in shown.reads:
            print_json(
                {
                    "device": read.device,
                    "class": read.poll_class,
                    "first": read.first,
                    "count": read.count,
                    "points": read.points,
                    "seconds": round(read.seconds, 6),
                    "undeclared": list(read.undeclared),
                }
            )
        for load in shown.loads:
            print_json({"link": load.link, "load": round(load.load, 4), "problems": list(load.problems)})
    else:
        print_aligned(
            [
                ["device", "class", "read", "items", "points", "time", "undeclared"],
                *(
                    [
                        read.device,
                        read.poll_class,
                        read.first,
                        str(read.count),
                        str(read.points),
                        f"{1000 * read.seconds:.1f} ms",
                        " ".join(read.undeclared),
                    ]
                    for read in shown.reads
                ),
            ]
        )
        for device, point, reason in shown.unreadable:
            print(f"{device}/{point} is not read: {reason}")
        for device, line in shown.learnt:
            print(f"{device}: {line}")
        for load in shown.loads:
            print(f"link {load.link}: {load.load:.3f} s of reads in every second")
            for problem in load.problems:
                print(f"  {problem}")
    return ExitCode.DONE if all(load.fits for load in shown.loads) else ExitCode.REFUSED


def _show_learnt(configuration: "CollectorConfiguration", pin: str | None, forget: str | None, *, as_json: bool) -> int:
    from ..apps.collector.learnt_file import LearntFile
    from ..apps.collector.store.folder import holder_of

    file = LearntFile(configuration.learnt_path)
    path, knowledge = file.path, file.read()
    if pin or forget:
        pid = holder_of(path.parent)
        if pid is not None:
            raise ConfigError(f"the collector with pid {pid} runs, and would write over the change", file=str(path))
        changed = knowledge.pin(pin) if pin else knowledge.forget(str(forget), pinned=True)
        if not changed:
            raise ConfigError(f"nothing was learnt of {pin or forget}", key="--pin" if pin else "--forget")
        file.write(knowledge.text())
    for name, known in knowledge:
        for line in known.lines():
            if as_json:
                print_json({"device": name, "learnt": line})
            else:
                print(f"{name}: {line}")
    for profile, firmware in knowledge.kinds():
        for line in knowledge.offered(profile, firmware).lines():
            if as_json:
                print_json({"profile": profile, "firmware": firmware, "offered": line})
            else:
                print(f"offered to {profile} with firmware {firmware}: {line}")
    return ExitCode.DONE

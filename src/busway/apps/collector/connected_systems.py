"""The other systems that a running collector is connected to: sinks, pages for Prometheus, servers that send commands.

Knows which of these systems a configuration has; how each of them works is its own affair.

1. A system whose ``[[sink]]`` section is the same in the old and the new configuration is not touched.
2. Steps that can fail are made before anything is changed (`prepare`): binding the port of a new page, and listing a
   new sink in the store. A page that gets the URL of a page that ends or moves takes over its listening socket.
3. A sink that is started anew goes on after the last commit that it has got; so does a sink that was removed and comes
   back later.
"""

import asyncio
import sqlite3
from collections.abc import Callable, Mapping, Sequence

from ...config.files.sinks import PrometheusSinkSection, SinkSection
from ...errors import ConfigError, LinkDown
from .cancellation import end_tasks
from .commands.command_messages import CommandInput, CommandMessageHandler, InputStatus
from .configuration import CollectorConfiguration
from .report_rules import points_of, sink_rules
from .sinks.delivery import SinkStatus
from .sinks.prometheus import PrometheusPage
from .sinks.sink_thread import CLOSE, SinkThread
from .store.writer import StoreWriter
from .task_errors import log_defect


class ConnectedSystems:
    """The sinks, pages for Prometheus and inputs of commands of a running collector.

    All methods but `close_sinks` are for the thread of the event loop.

    Args:
        page: makes a page for Prometheus from its section of the file; the page listens at once.
        handler: makes the handler of the commands from one server, from the name of its sink and its input.
    """

    def __init__(
        self,
        page: Callable[[PrometheusSinkSection], PrometheusPage],
        handler: Callable[[str, CommandInput], CommandMessageHandler],
    ) -> None:
        self._page, self._handler = page, handler
        self._keys: Mapping[str, SinkSection] = {}
        self._input_keys: Mapping[str, SinkSection] = {}
        self._thread: SinkThread | None = None
        self._pages: dict[str, PrometheusPage] = {}
        self._prepared: dict[str, PrometheusPage] = {}
        self._inherited: dict[str, str] = {}
        self._receiving: dict[str, tuple[CommandMessageHandler, asyncio.Task[None]]] = {}

    def begin(self, writer: StoreWriter, configuration: CollectorConfiguration) -> None:
        """Begin to send samples to the sinks of the first configuration, and to listen on its pages.

        Commands are received later, from `receive` on.

        Raises:
            ConfigError: a sink or page cannot be used as configured.
            LinkDown: the port of a page is in use.
        """
        for name, section in configuration.pages.items():
            self._pages[name] = self._page(section)
        self._thread = SinkThread(writer, configuration.sinks, sink_rules(configuration), points_of(configuration))
        self._keys = configuration.sink_keys

    def receive(self, configuration: CollectorConfiguration) -> None:
        """Start a task that receives commands for each input that has none yet; tasks of other inputs go on."""
        self._input_keys = configuration.input_keys
        for name, made in configuration.inputs.items():
            if name not in self._receiving:
                handler = self._handler(name, made)
                task = asyncio.create_task(handler.run(), name=f"busway commands of {name}")
                task.add_done_callback(log_defect)
                self._receiving[name] = handler, task

    def prepare(self, configuration: CollectorConfiguration) -> None:
        """Bind the ports of new or moved pages of another configuration, and list its new sinks in the store.

        Nothing that is in use changes. A page that gets the URL of a page that ends or moves binds nothing: it takes
        over that page. Ports that an earlier call has bound, and `apply` has not put into use, are released first.

        Raises:
            ConfigError: a port cannot be bound, a page cannot be made as configured or without a package that is not
                installed, or the store cannot be written now. No port stays bound.
        """
        self._discard()
        assert self._thread is not None
        try:
            for name in configuration.sinks.keys() - self._keys.keys():
                self._thread.reserve(name)
        except sqlite3.Error as error:
            raise ConfigError(f"the store cannot be written now: {error}", file=configuration.name) from error
        elsewhere = {name for name, section in configuration.pages.items() if self._is_elsewhere(name, section)}
        free = {self._keys[name].url: name for name in self._pages.keys() - (configuration.pages.keys() - elsewhere)}
        for name in elsewhere:
            section = configuration.pages[name]
            if section.url in free:
                self._inherited[name] = free.pop(section.url)
            else:
                try:
                    self._prepared[name] = self._page(section)
                except LinkDown as error:
                    self._discard()
                    raise ConfigError(error.message, file=configuration.name, key=f"sink.{name}.url") from error
                except ConfigError:
                    self._discard()
                    raise

    def check(self, configuration: CollectorConfiguration) -> None:
        """Raise `ConfigError` if `prepare` raises it. No port stays bound; new sinks stay listed in the store."""
        self.prepare(configuration)
        self._discard()

    def _is_elsewhere(self, name: str, section: SinkSection) -> bool:
        known = self._keys.get(name)
        return name not in self._pages or known is None or known.url != section.url

    def _discard(self) -> None:
        for page in self._prepared.values():
            page.close()
        self._prepared, self._inherited = {}, {}

    async def apply(self, configuration: CollectorConfiguration) -> list[str]:
        """Put the sinks, pages and inputs of another configuration into use.

        `prepare` must have been called with the same configuration. Receivers of changed inputs end before the new ones
        begin.

        Returns:
            One sentence for each ``[[sink]]`` section that is new, gone or changed, in the order of names; empty if
            there is none.
        """
        assert self._thread is not None
        new, before = configuration.sink_keys, self._keys
        changed = {name for name in before.keys() | new.keys() if before.get(name) != new.get(name)}
        inputs = self._input_keys.keys() | configuration.input_keys.keys()
        await self._end_inputs(
            {name for name in inputs if self._input_keys.get(name) != configuration.input_keys.get(name)}
        )
        self._change_pages(configuration)
        running = {each.name for each in self._thread.statuses()}
        for name in changed & running:
            await asyncio.to_thread(self._thread.remove, name)
        self._thread.set_points(points_of(configuration), sink_rules(configuration))
        for name in changed & configuration.sinks.keys():
            self._thread.add(name, *configuration.sinks[name])
        self._keys = new
        self.receive(configuration)
        return [
            f"sink {name} {'began' if name not in before else 'ended' if name not in new else 'began anew'}"
            for name in sorted(changed)
        ]

    def _change_pages(self, configuration: CollectorConfiguration) -> None:
        inherited = {name: self._pages[before] for name, before in self._inherited.items()}
        stays = configuration.pages.keys() - self._inherited.keys() - self._prepared.keys()
        pages = {name: self._pages[name] for name in stays} | inherited | self._prepared
        for page in self._pages.values():
            if page not in pages.values():
                page.close()
        self._pages = {name: pages[name] for name in configuration.pages}
        self._prepared, self._inherited = {}, {}
        for name, section in configuration.pages.items():
            self._pages[name].configure(section.points, section.stale)

    async def _end_inputs(self, names: set[str]) -> None:
        await end_tasks([self._receiving.pop(name)[1] for name in names & self._receiving.keys()], CLOSE)

    async def end_inputs(self) -> None:
        """Stop receiving commands: cancel all tasks, and wait until they have ended."""
        await self._end_inputs(set(self._receiving))

    def close_sinks(self) -> None:
        """Stop the sinks, and wait for their end; samples that they have not sent are sent after the next start.

        To be called in another thread than the event loop's, because it blocks.
        """
        if self._thread is not None:
            self._thread.close()

    def close_pages(self) -> None:
        """Close all pages for Prometheus and their ports, prepared ones too."""
        self._discard()
        for page in self._pages.values():
            page.close()

    @property
    def urls(self) -> list[str]:
        """The URLs of the pages for Prometheus."""
        return [page.url for page in self._pages.values()]

    def sink_statuses(self) -> Sequence[SinkStatus]:
        """Return the status of each sink, pages for Prometheus not included; empty before `begin`."""
        return () if self._thread is None else self._thread.statuses()

    def input_statuses(self) -> Sequence[InputStatus]:
        """Return the status of each input of commands: of the connection to each server that commands come from."""
        return [handler.status() for handler, _ in self._receiving.values()]

"""A gateway put together from a file, or from URLs: what becomes of its sections, and what a new reading changes."""

from pathlib import Path

import pytest
from policy_clients import PlainClient
from waiting import until
from whole_frames import line_of_whole_frames

import busway
from busway.apps.gateway.configuration import GatewayConfiguration, load_gateway, parse_gateway, simple_gateway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import UpstreamSettings
from busway.apps.gateway.overview import gateway_rows, routing_rows
from busway.apps.gateway.routes import AddressRange, RouteAction
from busway.apps.gateway.upstream import Upstream
from busway.apps.service.overrides import Overrides
from busway.apps.service.service import Service
from busway.options.gateway import UpstreamParameters
from busway.options.server import ListenerParameters, Scope

GOOD = Path(__file__).parents[2] / "config" / "files" / "gateway.toml"
ANY_PORT = "tcp://127.0.0.1:0"


def test_sections_become_listeners_lines_routes_and_options_of_servers() -> None:
    configuration = load_gateway(GOOD)
    plan = configuration.plan
    assert [(listener.name, listener.deadline) for listener in plan.listeners] == [("scada", 8.0), ("plc", 8.0)]
    limits = plan.listeners[0].settings.limits
    assert limits is not None
    assert (limits.max_connections, limits.idle_timeout) == (20, 600)
    hall, inverter = plan.upstreams
    assert (hall.link.parameters.timeout, hall.link.parameters.retries) == (0.5, 1)
    assert inverter.options == UpstreamParameters(4, share_reads=False, broadcast=True)
    first, second, third, fourth = plan.table.routes
    assert (first.action, first.code, first.listeners) == (RouteAction.REFUSE, 1, frozenset({"scada"}))
    assert (second.upstream, second.max_registers, second.timeout) == ("hall", 50, 0.6)
    assert third.addresses == AddressRange(busway.codes.Table.HOLDING_REGISTERS, 0, 100)
    assert (third.unit, third.shift, third.cache) == (1, 1000, 0.5)
    assert fourth.action is RouteAction.DROP
    assert plan.own_unit == 254
    assert configuration.audit == str(GOOD.parent / "audit.jsonl")
    assert plan.server["listener"] == ListenerParameters(idle_timeout=600)


def test_the_preset_strict_and_the_options_of_servers_hold_at_every_listener() -> None:
    text = f'listen = ["{ANY_PORT}", "rtu:///dev/not-there"]\n[server]\npreset = "strict"\nmax_transactions = 3\n'
    plan = parse_gateway(text + '[[link]]\nname = "x"\nurl = "tcp://10.0.0.5"\n', "x").plan
    assert plan.server["parameters"].max_transactions == 3
    assert plan.server["parameters"].scope is Scope.SERVER
    assert plan.server["standard_port"] is True
    assert plan.server["listener"].single_adu_segments
    endpoint = plan.listeners[1].settings.endpoint
    assert not isinstance(endpoint, str)
    assert endpoint.options["preset"] == "strict"


@pytest.mark.parametrize(
    ("url", "client", "link", "wanted"),
    [
        ("tcp://10.0.0.5", "", "", (1, 3)),
        ("tcp://10.0.0.5?preset=passive", "", "", (0, 0)),
        ("tcp://10.0.0.5", "", 'preset = "passive"', (0, 0)),
        ("tcp://10.0.0.5", 'preset = "passive"', "", (0, 0)),
        ("tcp://10.0.0.5?open_after=2", 'preset = "passive"', "", (0, 2)),
        ("tcp://10.0.0.5?preset=passive", "open_after = 2", "", (0, 2)),
        ("tcp://10.0.0.5", 'preset = "passive"', 'preset = "standard"', (1, 3)),
    ],
)
def test_a_preset_has_priority_over_the_defaults_of_a_gateway_and_given_options_over_the_preset(
    url: str, client: str, link: str, wanted: tuple[int, int]
) -> None:
    text = f'listen = ["{ANY_PORT}"]\n[client]\n{client}\n[[link]]\nname = "x"\nurl = "{url}"\n{link}\n'
    (upstream,) = parse_gateway(text, "x").plan.upstreams
    open_after = 0 if upstream.link.breaker is None else upstream.link.breaker.open_after
    assert (upstream.link.parameters.retries, open_after) == wanted


@pytest.mark.parametrize("url", ["tcp://10.0.0.5", "rtu:///dev/not-there"])
def test_no_unit_of_an_upstream_with_the_preset_passive_is_suspended(url: str) -> None:
    for upstream in (
        UpstreamSettings.of("a", f"{url}?preset=passive"),
        UpstreamSettings.of("a", url, preset="passive"),
        simple_gateway([ANY_PORT], f"{url}?preset=passive").plan.upstreams[0],
    ):
        breaker = upstream.link.breaker if upstream.link.line is None else upstream.link.line.breaker
        assert breaker is None or breaker.open_after == 0


def test_the_common_case_needs_urls_only_and_says_what_is_wrong_with_them() -> None:
    plan = simple_gateway([ANY_PORT, "udp://127.0.0.1:0"], "rtu:///dev/not-there?baud=9600").plan
    assert [listener.name for listener in plan.listeners] == [ANY_PORT, "udp://127.0.0.1:0"]
    twice = simple_gateway([ANY_PORT, ANY_PORT], "tcp://10.0.0.5").plan
    assert [listener.name for listener in twice.listeners] == [ANY_PORT, f"{ANY_PORT} (2)"]
    assert [line.link.endpoint.path for line in plan.upstreams] == ["/dev/not-there"]
    for listeners, line, sentence in (
        ([ANY_PORT], "rtu:///dev/x?baud=9", "baud: must be 50"),
        (["tcp://127.0.0.1:0?timeout=3"], "tcp://h", "timeout: unknown option of a listener"),
        (["tcp://127.0.0.1:99"] * 2, "tcp://h", "tcp://127.0.0.1:99 is taken by tcp://127.0.0.1:99"),
        (["rtu:///dev/a"], "rtu:///dev/a", "/dev/a is taken by listener rtu:///dev/a"),
        (["smtp://h"], "tcp://h", "smtp"),
    ):
        with pytest.raises(busway.ConfigError) as caught:
            simple_gateway(listeners, line)
        assert sentence in str(caught.value)
        assert caught.value.file is None


def test_certificates_of_lines_that_cannot_be_read_are_found_where_files_are_examined(tmp_path: Path) -> None:
    file = tmp_path / "gateway.toml"
    text = f'listen = ["{ANY_PORT}"]\n[[link]]\nname = "x"\nurl = "tls://10.0.0.5"\nauthority = "ca.pem"\n'
    file.write_text(text)
    assert load_gateway(file).plan.upstreams
    with pytest.raises(busway.ConfigError, match=r"gateway\.toml:5: link\[0\]\.authority: .*ca\.pem can ?not be read"):
        load_gateway(file, preflight=True)


def test_the_overview_names_listeners_lines_and_what_becomes_of_requests() -> None:
    configuration = load_gateway(GOOD)
    rows = {(kind, name): text for kind, name, text in gateway_rows(configuration)}
    assert "answers within 8 s" in rows["listener", "scada"]
    assert "4 connections" in rows["link", "inverter"]
    assert rows["own unit", "254"] == "the gateway itself, also by unit 0"
    assert list(routing_rows(configuration)) == [
        ("scada", "1-10", "05, 06, 15, 16, 21, 22, 23", "all", "refused: 01 illegal function", ""),
        ("all", "1-2, 4-10", "all", "all", "hall", "at most 50 registers at once; timeout 0.6 s"),
        ("all", "3", "all", "holding register 0…99", "inverter", "as unit 1; addresses +1000; remembered for 0.5 s"),
        ("all", "3", "all", "all", "dropped", ""),
    ]


class Files:
    """A gateway file that changes, and the service that runs it."""

    def __init__(self, *servers: str) -> None:
        self.servers = servers
        self.text = ""

    def read(self) -> GatewayConfiguration:
        lines = "".join(
            f'[[link]]\nname = "{name}"\nurl = "{url}"\n' for name, url in zip("ab", self.servers, strict=False)
        )
        return parse_gateway(self.text + lines, "x.toml")

    def service(self, *, standard_port: bool | None = None) -> Service:
        return Service(self.read, Overrides(control="off", can_reload=True, standard_port=standard_port))


LISTENER = '[[listener]]\nname = "office"\nurl = "tcp://127.0.0.1:0"\n'
ROUTES = '[[route]]\nunits = "1"\nlink = "a"\n[[route]]\nunits = "2"\nlink = "b"\n'


def device(first: int) -> busway.Device:
    return busway.Device(holding_registers=[first + n for n in range(20)])


async def read_from(link: busway.AsyncLink, unit: int) -> list[int]:
    return await link.unit(unit).read_holding_registers(0, count=1)


async def test_new_routes_hold_at_once_and_no_connection_ends() -> None:
    async with (
        busway.serve(ANY_PORT, units={1: device(100), 2: device(200)}) as one,
        busway.serve(ANY_PORT, units={1: device(300), 2: device(400)}) as two,
    ):
        files = Files(one.endpoints[0], two.endpoints[0])
        files.text = LISTENER + ROUTES
        async with files.service() as service, busway.open(service.server.endpoints[0]) as link:
            assert [await read_from(link, unit) for unit in (1, 2)] == [[100], [400]]
            assert await service.reload() == ["nothing has changed"]
            files.text = LISTENER + ROUTES.replace('link = "b"', 'link = "a"')
            assert await service.reload() == ["2 routes"]
            assert [await read_from(link, unit) for unit in (1, 2)] == [[100], [200]]
            files.text = LISTENER + ROUTES + "[gateway]\ndrain = 7\n[server]\nmax_connections = 3\n"
            assert await service.reload() == ["2 routes", "only the next start will see server, gateway"]
            assert link.counters.connections == 1
            assert len(one.status().connections) == 1


async def test_a_listener_that_is_renamed_changed_or_added_leaves_the_others_alone() -> None:
    async with busway.serve(ANY_PORT, units={1: device(100), 2: device(200)}) as one:
        files = Files(one.endpoints[0], one.endpoints[0])
        files.text = LISTENER + ROUTES
        async with files.service() as service, busway.open(service.server.endpoints[0]) as link:
            assert await read_from(link, 1) == [100]
            second = LISTENER.replace("office", "second")
            files.text = LISTENER + second + ROUTES
            assert await service.reload() == ["listener second added"]
            at = service.server.endpoints[1]
            async with busway.open(at) as other:
                assert await read_from(other, 1) == [100]
            # Under another name at the address that it has.
            third = second.replace("second", "third").replace("127.0.0.1:0", at.removeprefix("tcp://"))
            files.text = LISTENER + second.replace("127.0.0.1:0", at.removeprefix("tcp://")) + ROUTES
            assert await service.reload() == ["listener second changed"]
            files.text = LISTENER + third + ROUTES
            assert await service.reload() == ["listener third added", "listener second closed"]
            assert service.server.endpoints[1] == at
            async with busway.open(at) as other:
                assert await read_from(other, 1) == [100]
            assert await read_from(link, 2) == [200]
            assert link.counters.connections == 1


async def test_what_a_listener_tells_its_requests_changes_without_its_connections() -> None:
    async with busway.serve(ANY_PORT, units={1: device(100), 2: device(200)}) as one:
        files = Files(one.endpoints[0], one.endpoints[0])
        files.text = LISTENER + ROUTES
        async with files.service() as service, busway.open(service.server.endpoints[0]) as link:
            assert await read_from(link, 1) == [100]
            files.text = LISTENER + "client_deadline = 4.5\n" + ROUTES
            assert await service.reload() == ["listener office changed"]
            gateway = service.server
            assert isinstance(gateway, Gateway)
            assert gateway.plan.listeners[0].deadline == 4.5
            assert await read_from(link, 2) == [200]
            assert link.counters.connections == 1


@pytest.mark.real_time
async def test_a_serial_line_with_other_options_has_its_port_back_for_the_next_request() -> None:
    with line_of_whole_frames(ports=2, baud=115_200) as wire:
        near, far = (f"rtu://{path}?baud=115200" for path in wire.paths)
        async with busway.serve(far, units={1: device(100), 2: device(200)}):
            options = ["timeout = 0.3\n"]
            text = LISTENER + f'[[link]]\nname = "a"\nurl = "{near}"\n'
            service = Service(
                lambda: parse_gateway(text + options[0], "x.toml"), Overrides(control="off", can_reload=True)
            )
            async with service, busway.open(service.server.endpoints[0]) as link:
                assert await read_from(link, 1) == [100]
                options[0] = "timeout = 0.4\n"
                assert await service.reload() == ["link a changed"]
                assert await read_from(link, 2) == [200]
                # The listener that is added cannot be had: the line has its port, and its options, again.
                options[0] = "timeout = 0.5\n" + LISTENER.replace("office", "x").replace(
                    "127.0.0.1:0", "192.0.2.1:5020"
                )
                with pytest.raises(busway.LinkDown, match="cannot listen"):
                    await service.reload()
                gateway = service.server
                assert isinstance(gateway, Gateway)
                assert gateway.plan.upstreams[0].link.parameters.timeout == 0.4
                assert await read_from(link, 1) == [100]
                assert link.counters.connections == 1


async def test_what_cannot_be_had_changes_nothing_neither_routes_nor_policy() -> None:
    async with (
        busway.serve(ANY_PORT, units={1: device(100), 2: device(200)}) as one,
        busway.serve(ANY_PORT, units={1: device(0)}) as neighbour,
    ):
        files = Files(one.endpoints[0], one.endpoints[0])
        files.text = LISTENER + ROUTES
        async with files.service() as service, busway.open(service.server.endpoints[0]) as link:
            await link.unit(1).write_single_register(1, 5)
            taken = f'[[listener]]\nname = "taken"\nurl = "{neighbour.endpoints[0]}"\n'
            files.text = LISTENER + taken + '[policy]\ndefault = "deny"\n' + ROUTES.replace("2", "3")
            with pytest.raises(busway.LinkDown, match="the port is taken"):
                await service.reload()
            await link.unit(2).write_single_register(1, 6)
            files.text = LISTENER + ROUTES + "[[route]]\n"
            with pytest.raises(busway.ConfigError, match=r"x\.toml:10: route\[2\]: needs exactly one"):
                await service.reload()
            await link.unit(2).write_single_register(1, 7)


async def test_a_new_listener_that_the_network_reaches_is_read_only_from_its_first_request_on() -> None:
    async with busway.serve(ANY_PORT, units={1: device(100), 2: device(200)}) as one:
        files = Files(one.endpoints[0], one.endpoints[0])
        files.text = LISTENER + ROUTES
        async with files.service(standard_port=False) as service:
            assert service.read_only == ()
            files.text = LISTENER + LISTENER.replace("127.0.0.1", "0.0.0.0").replace("office", "wide") + ROUTES
            assert await service.reload() == ["listener wide added"]
            assert service.read_only == (service.server.endpoints[1],)
            wide = service.server.endpoints[1].replace("0.0.0.0", "127.0.0.1")
            async with busway.open(wide) as link, busway.open(service.server.endpoints[0]) as loopback:
                with pytest.raises(busway.ExceptionReply, match="exception 01"):
                    await link.unit(1).write_single_register(0, 1)
                await loopback.unit(1).write_single_register(0, 1)


@pytest.mark.clause("M6")
async def test_new_routes_the_policy_and_the_lists_with_them_hold_in_one_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """While the connections of an upstream that goes are closed, its routes are gone, and so are its rights."""
    meanwhile: list[bytes] = []
    close = Upstream.close

    async def close_slowly(upstream: Upstream) -> None:
        if not meanwhile and upstream.name == "a":
            write = b"\x06\x00\x01\x00\x07"
            for host in ("127.0.0.2", "127.0.0.3"):
                clients[host].send(clients[host].frame(1, 1, write))
            meanwhile.extend([reply.pdu for reply in await clients["127.0.0.2"].receive(1)])
            await until(lambda: clients["127.0.0.3"].lost or clients["127.0.0.3"].unexpected)
        await close(upstream)

    plant, sandbox = device(100), device(200)
    async with (
        busway.serve(ANY_PORT, units={1: plant}) as real,
        busway.serve(ANY_PORT, units={1: sandbox}) as test,
    ):
        files = Files(test.endpoints[0])
        files.text = LISTENER + '[[route]]\nlink = "a"\n[policy]\ndefault = "allow"\n'
        async with files.service() as service:
            clients = {
                host: await PlainClient.dial(service.server.endpoints[0], host) for host in ("127.0.0.2", "127.0.0.3")
            }
            monkeypatch.setattr(Upstream, "close", close_slowly)
            files.servers = (real.endpoints[0],)
            files.text = LISTENER + '[[route]]\nlink = "a"\n[policy]\ndefault = "read-only"\ndeny = ["127.0.0.3"]\n'
            assert await service.reload() == [
                "link a changed",
                "the policy was replaced",
                "connections of hosts that may no longer connect were ended: 1",
            ]
            assert meanwhile == [b"\x86\x01"]
            assert plant.holding_registers[1] == 101
            for client in clients.values():
                client.close()


async def test_lists_of_a_listener_are_replaced_and_connections_of_hosts_that_are_now_denied_end() -> None:
    async with busway.serve(ANY_PORT, units={1: device(100), 2: device(200)}) as one:
        files = Files(one.endpoints[0], one.endpoints[0])
        files.text = LISTENER + 'allow = ["127.0.0.1"]\n' + ROUTES
        async with files.service() as service, busway.open(service.server.endpoints[0]) as link:
            assert await read_from(link, 1) == [100]
            files.text = LISTENER + 'deny = ["127.0.0.1"]\n' + ROUTES
            assert await service.reload() == [
                "the address lists of listeners were replaced",
                "connections of hosts that may no longer connect were ended: 1",
            ]
            with pytest.raises((busway.LinkDown, busway.NoReply)):
                await read_from(link, 1)
            async with busway.open(service.server.endpoints[0], shared=False, retries=0) as refused:
                with pytest.raises((busway.LinkDown, busway.NoReply)):
                    await read_from(refused, 1)
            files.text = LISTENER + 'allow = ["127.0.0.0/8"]\n' + ROUTES
            assert await service.reload() == ["the address lists of listeners were replaced"]
            async with busway.open(service.server.endpoints[0], shared=False) as welcome:
                assert await read_from(welcome, 1) == [100]


async def test_a_rate_counts_for_all_listeners_together() -> None:
    rule = '[policy]\ndefault = "allow"\n[[policy.rule]]\nname = "slowly"\naction = "allow"\nrate = 0.001\n'
    async with busway.serve(ANY_PORT, units={1: device(100), 2: device(200)}) as one:
        files = Files(one.endpoints[0], one.endpoints[0])
        files.text = LISTENER + LISTENER.replace("office", "second") + ROUTES + rule
        async with files.service() as service:
            first, second = service.server.endpoints
            async with busway.open(first) as link:
                assert await read_from(link, 1) == [100]
            async with busway.open(second) as link:
                with pytest.raises(busway.ExceptionReply, match="exception 06"):
                    await read_from(link, 1)
            gateway = service.server
            assert isinstance(gateway, Gateway)
            assert [dict(listener.server.refusals) for listener in gateway.status().gateway_listeners] == [
                {},
                {"slowly": 1},
            ]


async def test_counters_are_reset_and_the_sum_of_listeners_is_that_of_the_gateway() -> None:
    async with busway.serve(ANY_PORT, units={1: device(100), 2: device(200)}) as one:
        files = Files(one.endpoints[0], one.endpoints[0])
        files.text = LISTENER + LISTENER.replace("office", "second") + ROUTES
        async with files.service() as service:
            gateway = service.server
            assert isinstance(gateway, Gateway)
            for endpoint in gateway.endpoints:
                async with busway.open(endpoint, shared=False) as link:
                    assert await read_from(link, 1) == [100]
                    with pytest.raises(busway.ExceptionReply):
                        await read_from(link, 9)
            await until(lambda: gateway.status().counters.closed == 2)
            status = gateway.status()
            assert (status.counters.requests, status.counters.other.accepted) == (4, 2)
            assert (status.local_connections, status.supported_connections) == (1, 128)
            assert [listener.counters.no_route for listener in status.gateway_listeners] == [1, 1]
            gateway.reset_counters()
            status = gateway.status()
            assert (status.counters.requests, status.upstreams[0].counters.forwarded) == (0, 0)
            assert [listener.counters.no_route for listener in status.gateway_listeners] == [0, 0]

"""What a collector of a fleet makes of a plant's configuration."""

from pathlib import Path

import pytest
from fleet_devices import FleetDevice, plant

from busway.apps.collector.configuration import CollectorConfiguration, parse_collector
from busway.apps.collector.sinks.sparkplug import SparkplugSink
from busway.apps.fleet.lease_times import LeaseTimes
from busway.apps.fleet.plant_configuration import (
    link_times,
    links_of_shards,
    name_edge_nodes,
    refuse_links_of_one_subject,
    refuse_moved_endpoints,
    refuse_ports_of_any_host,
    refuse_slow_links,
    refuse_two_owners,
    with_short_user_timeout,
)
from busway.apps.fleet.shards import shard_of
from busway.errors import ConfigError


@pytest.mark.parametrize(
    ("url", "more", "longest"),
    [
        ("tcp://127.0.0.1:502", "timeout = 2", 5.0),
        ("tcp://127.0.0.1:502?user_timeout=20", "timeout = 2", 5.0),
        ("tcp://127.0.0.1:502", "timeout = 2\nuser_timeout = 1", 5.0),
        ("rtu+tcp://127.0.0.1:502", "timeout = 2\nconnect_timeout = 1", 3.0),
        ("udp://127.0.0.1:502", "timeout = 2", 5.0),
        ("rtu:///dev/ttyUSB0", "timeout = 2", 2.0),
    ],
)
def test_the_system_repeats_no_request_for_longer_than_the_transaction_may_take(
    tmp_path: Path, url: str, more: str, longest: float
) -> None:
    text = plant(tmp_path / "store", [FleetDevice("hall", 502)], more).replace("tcp://127.0.0.1:502", url)
    configuration = with_short_user_timeout(parse_collector(text, "x.toml"))
    assert link_times(configuration)["hall"].transaction == longest


def made(tmp_path: Path, *links: tuple[str, str, list[str]]) -> CollectorConfiguration:
    """A plant of links, each with its name, endpoint and hosts."""
    text = plant(tmp_path / "store", [])
    for name, url, hosts in links:
        text += f'[[link]]\nname = "{name}"\nurl = "{url}"\nhosts = {hosts}\n'
    profile = tmp_path / "meter.toml"
    text += f'[[device]]\nname = "d"\nlink = "{links[0][0]}"\nunit = 1\nprofile = "{profile}"\npoll_class = "fast"\n'
    return parse_collector(text, "x.toml")


PORT, OTHER = "rtu:///dev/ttyUSB0", "rtu:///dev/ttyUSB1"


@pytest.mark.parametrize("url", ["tcp://10.0.0.5", "rtu+tcp://gateway:4001", "udp://10.0.0.5:502"])
def test_links_to_one_endpoint_have_one_owner_whatever_their_names(tmp_path: Path, url: str) -> None:
    plain = made(tmp_path, ("a", url, []), ("zz", f"{url}?timeout=2", []), ("other", "tcp://10.0.0.6", []))
    found = links_of_shards(plain, 256)
    assert found == {shard_of("a", 256): ["a", "zz"], shard_of("other", 256): ["other"]}
    with pytest.raises(ConfigError, match=r"links a and zz are one endpoint, .*, with different hosts"):
        refuse_two_owners(made(tmp_path, ("a", url, ["box-1"]), ("zz", url, ["box-2"])))
    refuse_two_owners(made(tmp_path, ("a", url, ["box-1"]), ("zz", url, ["box-1"])))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("tcp://[fd00::5]", "tcp://[FD00:0:0:0:0:0:0:5]:502"),
        ("tcp://[fe80::5%25eth0]", "udp://[FE80:0::5%25eth0]"),
        ("tcp://10.0.0.5", "tcp://[::ffff:10.0.0.5]"),
        ("tcp://gateway.hall.", "tcp://Gateway.hall"),
        ("rtu:///dev/ttyUSB0", "rtu:///dev//./ttyUSB0"),
    ],
)
def test_an_endpoint_that_is_spelt_in_two_ways_has_one_owner(tmp_path: Path, one: str, other: str) -> None:
    found = links_of_shards(made(tmp_path, ("a", one, []), ("zz", other, [])), 256)
    assert found == {shard_of("a", 256): ["a", "zz"]}
    with pytest.raises(ConfigError, match=r"is that of link a, .* link zz:"):
        refuse_moved_endpoints(made(tmp_path, ("a", one, [])), made(tmp_path, ("zz", other, [])))


def test_a_serial_port_belongs_to_the_hosts_that_it_names_and_another_host_has_another_line(tmp_path: Path) -> None:
    plain = made(tmp_path, ("bus", PORT, ["box-1", "box-2"]), ("far", PORT, ["box-3"]), ("net", "tcp://10.0.0.5", []))
    refuse_ports_of_any_host(plain)
    refuse_two_owners(plain)
    assert links_of_shards(plain, 8) == {
        "pin.box-1.box-2": ["bus"],
        "pin.box-3": ["far"],
        shard_of("net", 8): ["net"],
    }
    with pytest.raises(ConfigError, match=r"/dev/ttyUSB0 is a port of one machine, .*hosts = "):
        refuse_ports_of_any_host(made(tmp_path, ("bus", PORT, [])))
    with pytest.raises(ConfigError, match="with different hosts"):
        refuse_two_owners(made(tmp_path, ("a", PORT, ["box-1", "box-2"]), ("b", PORT, ["box-2"])))


@pytest.mark.parametrize(
    ("before", "after", "refused"),
    [
        (("a", "tcp://10.0.0.5", []), ("b", "tcp://10.0.0.5", []), "10.0.0.5:502 is that of link a, .* link b:"),
        (("a", "tcp://10.0.0.5", []), ("a", "tcp://10.0.0.5", ["box"]), "link a, .* link a on box:"),
        (("a", PORT, ["box"]), ("a", PORT, ["box", "other"]), "ttyUSB0 of box is .* on box and other"),
        (("a", "tcp://10.0.0.5", []), ("a", "tcp://10.0.0.6", []), ""),
        (("a", PORT, ["box"]), ("a", OTHER, ["box"]), ""),
        (("a", PORT, ["box"]), ("b", PORT, ["other"]), ""),
        (("a", PORT, []), ("a", PORT, ["box"]), ""),
    ],
)
def test_an_endpoint_does_not_go_to_another_shard_in_one_step(
    tmp_path: Path, before: tuple[str, str, list[str]], after: tuple[str, str, list[str]], refused: str
) -> None:
    if refused:
        with pytest.raises(ConfigError, match=refused):
            refuse_moved_endpoints(made(tmp_path, before), made(tmp_path, after))
    else:
        refuse_moved_endpoints(made(tmp_path, before), made(tmp_path, after))


@pytest.mark.parametrize("hosts", [["a.b"], [""], ["a", "b", "c"], ["a", "a"]])
def test_hosts_that_cannot_be_are_refused_with_their_line(tmp_path: Path, hosts: list[str]) -> None:
    with pytest.raises(ConfigError, match=r"x\.toml:\d+: .*host"):
        made(tmp_path, ("a", PORT, hosts))


def test_each_collector_of_a_fleet_is_an_edge_node_of_its_own(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    pytest.importorskip("google.protobuf")

    def configured(edge_node: str) -> CollectorConfiguration:
        sink = f'[[sink]]\nname = "scada"\nurl = "sparkplug+mqtt://127.0.0.1"\ngroup = "g"\nedge_node = "{edge_node}"\n'
        return parse_collector(plant(tmp_path / "store", [FleetDevice("hall", 502)]) + sink, "x.toml")

    configuration = configured("hall-{collector}")
    name_edge_nodes(configuration, "west")
    sink, _ = configuration.sinks["scada"]
    assert isinstance(sink, SparkplugSink)
    assert sink.edge_node == "hall-west"
    with pytest.raises(ConfigError, match=r"sink\.scada\.edge_node: names one edge node.*add \{collector\}"):
        name_edge_nodes(configured("hall"), "west")


def test_what_a_gateway_holds_is_a_part_of_each_transaction_of_all_links_to_it(tmp_path: Path) -> None:
    quick = "timeout = 1\nconnect_timeout = 0.5"
    devices = [FleetDevice("a", 502), FleetDevice("b", 502), FleetDevice("other", 503)]
    text = plant(tmp_path / "store", devices, quick)
    assert {each.held for each in link_times(parse_collector(text, "x.toml")).values()} == {0.0}
    text = text.replace('name = "a"\n', 'name = "a"\ngateway_wait = 2.5\n', 1)
    text = text.replace('name = "b"\n', 'name = "b"\ngateway_wait = 1\n', 1)
    times = link_times(with_short_user_timeout(parse_collector(text, "x.toml")))
    assert {name: (each.after_sending, each.transaction) for name, each in times.items()} == {
        "a": (3.5, 4.0), "b": (3.5, 4.0), "other": (1.0, 1.5)
    }  # fmt: skip


@pytest.mark.parametrize(
    ("wait", "said"),
    [
        ("12", r"may take 13\.5 s, 12 s of it in a gateway, and a lease of 15 s leaves 8 s: .*fleet apply --ttl 26s"),
        ("299", r"299 s of it in a gateway, .* or let leases hold longer$"),
        ("6.5", ""),
    ],
)
def test_a_gateway_that_holds_requests_for_longer_than_leases_allow_is_refused(
    tmp_path: Path, wait: str, said: str
) -> None:
    text = plant(
        tmp_path / "store", [FleetDevice("a", 502)], f"timeout = 1\nconnect_timeout = 0.5\ngateway_wait = {wait}"
    )
    configuration = with_short_user_timeout(parse_collector(text, "x.toml"))
    if said:
        with pytest.raises(ConfigError, match=said):
            refuse_slow_links(configuration, LeaseTimes())
    else:
        refuse_slow_links(configuration, LeaseTimes())
    if wait == "12":
        refuse_slow_links(configuration, LeaseTimes.lasting(26.0))


@pytest.mark.parametrize("wait", ["-1", "301", '"long"'])
def test_a_wait_that_cannot_be_is_refused_with_its_line(tmp_path: Path, wait: str) -> None:
    with pytest.raises(ConfigError, match=r"x\.toml:\d+: .*gateway_wait"):
        parse_collector(plant(tmp_path / "store", [FleetDevice("a", 502)], f"gateway_wait = {wait}"), "x.toml")


def test_two_links_whose_commands_would_come_on_one_subject_are_refused(tmp_path: Path) -> None:
    refuse_links_of_one_subject(made(tmp_path, ("line.1", "tcp://10.0.0.5", []), ("line-1", "tcp://10.0.0.6", [])))
    both = made(tmp_path, ("line.1", "tcp://10.0.0.5", []), ("line_1", "tcp://10.0.0.6", []))
    with pytest.raises(ConfigError, match=r"links line\.1 and line_1 would take commands on one subject"):
        refuse_links_of_one_subject(both)

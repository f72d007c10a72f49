"""What a collector of a fleet makes of a plant's configuration."""

from pathlib import Path

import pytest
from fleet_devices import FleetDevice, plant

from busway.apps.collector.configuration import CollectorConfiguration, parse_collector
from busway.apps.collector.sinks.sparkplug import SparkplugSink
from busway.apps.fleet.plant import (
    links_of_shards,
    longest_transaction,
    name_edge_nodes,
    refuse_moved_endpoints,
    refuse_ports_of_any_host,
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
    assert longest_transaction(configuration, "hall") == longest


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

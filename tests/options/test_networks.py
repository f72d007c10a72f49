"""Lists of addresses and networks: what is in them, however a host is written, and which entries are refused."""

import ipaddress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.errors import ConfigError
from busway.options.networks import NetworkIndex, Networks, host_of_peer


@pytest.mark.parametrize(
    ("entries", "host", "found"),
    [
        (["10.0.0.7"], "10.0.0.7", "10.0.0.7"),
        (["10.0.0.7"], "10.0.0.8", None),
        (["10.0.0.0/8", "10.1.0.0/16"], "10.1.2.3", "10.1.0.0/16"),
        (["10.0.0.0/255.0.0.0"], "10.1.2.3", "10.0.0.0/255.0.0.0"),
        (["0.0.0.0/0"], "203.0.113.9", "0.0.0.0/0"),
        (["0.0.0.0/0"], "fe80::1", None),
        (["::/0"], "fe80::1", "::/0"),
        (["::/0"], "10.0.0.7", None),
        (["10.0.0.0/8"], "::ffff:10.0.0.7", "10.0.0.0/8"),
        (["::ffff:10.0.0.0/104"], "10.0.0.7", "::ffff:10.0.0.0/104"),
        (["::ffff:10.0.0.7"], "::ffff:a00:7", "::ffff:10.0.0.7"),
        (["fe80::/64"], "fe80::1%eth0", "fe80::/64"),
        (["fe80::1%eth0"], "fe80::1%eth0", "fe80::1%eth0"),
        (["fe80::1%eth0"], "fe80::1%eth1", None),
        (["fe80::1%eth0"], "fe80::1", None),
        (["2001:db8::/32"], "2001:DB8:0::1", "2001:db8::/32"),
        (["10.0.0.7"], "/dev/ttyUSB0", None),
        (["10.0.0.7"], "", None),
        ([], "10.0.0.7", None),
    ],
)
def test_the_most_specific_entry_that_holds_a_host_is_found(entries, host, found):
    networks = Networks(entries)
    for _ in range(2):  # the second time from memory
        assert networks.find(host) == found
        assert (host in networks) == (found is not None)


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("10.0.0.7/24", "the network is 10.0.0.0/24, the address alone 10.0.0.7"),
        ("fe80::1/64", "the network is fe80::/64"),
        ("localhost", "'localhost' is no address or network"),
        ("10.0.0", "no address or network"),
        ("10.0.0.0/33", "no address or network"),
        ("010.0.0.1", "no address or network"),
        ("10.0.0.1%eth0", "only an IPv6 address has a zone"),
        ("fe80::1%", "only an IPv6 address has a zone"),
        ("", "no address or network"),
        (7, "7 is no text"),
    ],
)
def test_an_entry_that_cannot_be_is_named(entry, said):
    with pytest.raises(ConfigError) as caught:
        Networks(["10.0.0.1", entry], key="allow")
    assert said in caught.value.message
    assert caught.value.key == "allow"


def test_a_text_alone_is_no_list():
    with pytest.raises(ConfigError, match="a list of addresses is needed"):
        Networks("10.0.0.1")


def test_what_is_remembered_of_hosts_is_bounded():
    networks = Networks(["10.0.0.0/8"])
    for number in range(5000):
        assert str(ipaddress.IPv4Address(0x0A000000 + number)) in networks
    assert len(networks._found) <= 1024


def test_two_lists_of_the_same_entries_are_equal():
    assert Networks(["10.0.0.0/8", "::1"]) == Networks.parse(["::1", "10.0.0.0/8"])
    assert hash(Networks(["::1"])) == hash(Networks(["::1"]))
    assert Networks(["::1"]) != Networks(["::2"])
    assert list(Networks(["::1"])) == ["::1"]


addresses = st.one_of(st.ip_addresses(v=4), st.ip_addresses(v=6))


@given(st.lists(st.tuples(addresses, st.integers(0, 32)), max_size=8), st.lists(addresses, max_size=8))
def test_it_says_what_the_networks_say_one_by_one(entries, hosts):
    networks = [ipaddress.ip_network(f"{address}/{length}", strict=False) for address, length in entries]
    listed = Networks([str(network) for network in networks])
    for host in [*hosts, *(network.network_address for network in networks)]:
        plain = getattr(host, "ipv4_mapped", None) or host
        assert (str(host) in listed) == any(plain in network for network in networks)


@pytest.mark.parametrize(
    ("peer", "host"),
    [
        ("10.0.0.7:5000", "10.0.0.7"),
        ("10.0.0.7", "10.0.0.7"),
        ("[fe80::1%eth0]:502", "fe80::1%eth0"),
        ("[::1]", "::1"),
        ("fe80::1", "fe80::1"),
        ("[::ffff:10.0.0.7]:502", "10.0.0.7"),
        ("/dev/ttyUSB0", "/dev/ttyUSB0"),
        ("", ""),
        ("?", "?"),
    ],
)
def test_the_host_of_a_peer(peer, host):
    assert host_of_peer(peer) == host


def test_an_index_finds_the_networks_that_a_host_is_in_as_each_of_them_would() -> None:
    networks = [
        Networks(["10.0.0.0/8", "192.0.2.1"]),
        Networks(["10.0.0.7"]),
        Networks(["fe80::/64"]),
        Networks(["fe80::1%eth0"]),
        Networks([]),
        Networks(["::ffff:10.0.0.0/104"]),
    ]
    index = NetworkIndex(enumerate(networks))
    for host in ("10.0.0.7", "10.1.2.3", "::ffff:10.0.0.7", "192.0.2.1", "fe80::1", "fe80::1%eth0", "::1", "ttyS0", ""):
        assert index.find(host) == {number for number, each in enumerate(networks) if host in each}

"""The interfaces of this host, as the system tells them."""

import ctypes
import errno
import socket
import struct
import sys
from pathlib import Path

import pytest

from busway.transport import network_interfaces as interfaces
from busway.transport.network_interfaces import Interface, interfaces_with

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux is asked")


@pytest.mark.clause("T20")
def test_the_loopback_interface_has_its_address_and_netmask() -> None:
    assert interfaces_with("127.0.0.1") == (Interface("lo", "127.0.0.1", "255.0.0.0"),)
    assert interfaces_with("::1") == (Interface("lo", "::1", "/128"),)
    assert Interface("lo", "127.0.0.1", "255.0.0.0") in interfaces_with("0.0.0.0")
    assert interfaces_with("192.0.2.1") == ()


def test_every_address_of_an_interface_is_found_with_its_own_netmask(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    held = {
        b"10.0.0.5": (b"eth0", b"255.255.255.0"),
        b"10.0.0.6": (b"eth0", b"255.255.255.128"),
        b"10.1.0.1": (b"eth0:1", b"255.255.0.0"),
    }

    def entry(label: bytes, address: bytes) -> bytes:
        numeric = socket.inet_aton(address.decode())
        # name, family, port, address, and what other members of the structure need
        return struct.pack("16sHH4s", label, socket.AF_INET, 0, numeric).ljust(interfaces._ENTRY.size, b"\0")

    def ioctl(descriptor: int, request: int, argument: bytes) -> bytes:
        if request == 0x8912:  # SIOCGIFCONF: size and address of a buffer
            size, where = struct.unpack("iP", argument)
            data = b"".join(entry(label, address) for address, (label, _) in held.items())
            assert len(data) <= size
            ctypes.memmove(where, data, len(data))
            return struct.pack("iP", len(data), where)
        assert request == 0x891B  # SIOCGIFNETMASK of a label's address
        label, netmask = held[socket.inet_ntoa(argument[20:24]).encode()]
        assert argument[:16].rstrip(b"\0") == label
        return entry(label, netmask)

    monkeypatch.setattr("fcntl.ioctl", ioctl)
    monkeypatch.setattr(interfaces, "_ROUTES", tmp_path / "none")
    assert interfaces_with("10.0.0.6") == (Interface("eth0", "10.0.0.6", "255.255.255.128"),)
    assert [(one.name, one.address, one.netmask) for one in interfaces_with("0.0.0.0")] == [
        ("eth0", "10.0.0.5", "255.255.255.0"),
        ("eth0", "10.0.0.6", "255.255.255.128"),
        ("eth0", "10.1.0.1", "255.255.0.0"),
    ]


def test_without_a_descriptor_left_there_is_nothing_to_show(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> socket.socket:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(interfaces.socket, "socket", refused)
    assert interfaces_with("127.0.0.1") == ()


@pytest.mark.clause("T20")
def test_the_gateway_is_that_of_the_default_route(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    gateway = int.from_bytes(socket.inet_aton("10.0.0.254"), sys.byteorder)
    table = tmp_path / "route"
    table.write_text(
        "Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\n"
        "lo\t0000000A\t00000000\t0001\t0\t0\t0\t00FFFFFF\n"
        f"lo\t00000000\t{gateway:08X}\t0003\t0\t0\t0\t00000000\n"
    )
    monkeypatch.setattr(interfaces, "_ROUTES", table)
    (found,) = interfaces_with("127.0.0.1")
    assert found.gateway == "10.0.0.254"


def test_a_system_that_does_not_tell_has_nothing_to_show(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(interfaces, "_IPV6_ADDRESSES", tmp_path / "none")
    assert interfaces_with("::1") == ()
    monkeypatch.setattr(sys, "platform", "other")
    assert interfaces_with("127.0.0.1") == ()

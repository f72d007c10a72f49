"""How links and units look where a program prints them, and how a number that is no address is answered."""

import asyncio

import pytest

import busway


def test_a_link_shows_where_it_leads_and_how_it_stands() -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=1)}) as server:
        url = server.endpoints[0]
        link = busway.connect(url)
        assert repr(link) == f"<Link {url} not connected>"
        assert repr(link.unit(1)) == f"<Unit 1 of {url}>"
        link.unit(1).read("4x1")
        assert repr(link) == f"<Link {url} connected>"
        link.close()
        assert repr(link) == f"<Link {url} closed>"


def test_an_asyncio_link_shows_the_same() -> None:
    async def main() -> None:
        async with busway.serve("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=1)}) as server:
            url = server.endpoints[0]
            link = busway.open(url)
            assert repr(link) == f"<AsyncLink {url} not connected>"
            assert repr(link.unit(1)) == f"<AsyncUnit 1 of {url}>"
            await link.unit(1).read("4x1")
            assert repr(link) == f"<AsyncLink {url} connected>"
            await link.close()
            assert repr(link) == f"<AsyncLink {url} closed>"

    asyncio.run(main())


@pytest.mark.parametrize(
    ("address", "hint"),
    [
        (40001, "write '40001' for holding register 1, or 'holding:40001' for offset 40001"),
        (30017, "write '30017' for input register 17, or 'holding:30017' for offset 30017"),
        (10002, "write '10002' for discrete input 2, or 'holding:10002' for offset 10002"),
        (100, "write for example '4x101' or 'holding:100'"),
        (50001, "write for example '4x50002' or 'holding:50001'"),
    ],
)
def test_a_number_alone_is_answered_with_what_it_may_mean(address: int, hint: str) -> None:
    with busway.connect("tcp://127.0.0.1:1") as link, pytest.raises(busway.InvalidRequest) as caught:
        link.unit(1).read(address)
    assert str(caught.value).endswith(f"address {address} names no table; {hint}")

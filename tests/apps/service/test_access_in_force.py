"""Policy and address lists of a running service: what holds at a listener that a reload adds."""

from busway.access.addresses import AddressList
from busway.apps.gateway.configuration import GatewayConfiguration, parse_gateway
from busway.apps.service.access_in_force import AccessInForce, ReloadableAllowList
from busway.apps.service.overrides import Overrides

LINK = '[[link]]\nname = "x"\nurl = "tcp://10.0.0.5"\n'
FIRST = '[[listener]]\nurl = "tcp://127.0.0.1:5020"\n'
SECOND = '[[listener]]\nurl = "tcp://127.0.0.1:5021"\nallow = ["127.0.0.2"]\n'


def gateway(text: str) -> GatewayConfiguration:
    return parse_gateway(text + LINK, "x.toml")


def test_a_listener_that_stays_keeps_its_list_and_one_that_comes_back_begins_with_the_list_of_its_file() -> None:
    files = [gateway(FIRST + SECOND), gateway(FIRST), gateway(FIRST + SECOND.replace("127.0.0.2", "127.0.0.3"))]
    access = AccessInForce(files[0], Overrides())
    lists = []
    for file, expected in zip(files, ([True, True], [True], [True, False]), strict=True):
        found = [one.access for one in access.listeners(file)]
        assert [may is not None and may("127.0.0.2") for may in found] == expected  # before the listeners are open
        access.replace_lists(file, None)
        lists.append(found[0])
    assert lists[0] is lists[1] is lists[2]


def test_a_reloadable_allow_list_asks_all_of_its_lists_and_takes_others() -> None:
    allow_list = ReloadableAllowList([AddressList(allow=["10.0.0.0/8"]), AddressList(deny=["10.0.0.9"])])
    assert [allow_list(host) for host in ("10.0.0.1", "10.0.0.9", "192.0.2.1")] == [True, False, False]
    allow_list.lists = ()
    assert allow_list("192.0.2.1")

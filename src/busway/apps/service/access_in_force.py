"""The access policy and address lists that a running service applies, and their replacement by a reload.

Knows rules, lists and listeners; knows no file, and not when a reload happens.

1. Without a policy, listeners that the network reaches are read-only (`listeners_without_policy`), unless writes were
   allowed on the command line.
2. A listener keeps its `ReloadableAllowList` for as long as the service lives; only the lists in it change.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

from ...access.addresses import AddressList
from ...access.rules import AccessRules, Policy
from ...server.listener import Listener
from .listeners_without_policy import NETWORK_SCHEMES, reaches_network, read_only_for
from .overrides import Overrides
from .service_interfaces import DeclaredServer, RunningServer


class ReloadableAllowList:
    """Access check of a server (its ``authorize``), by address lists that can be replaced while it runs.

    Calling it with the numeric address of a host returns True if the host may connect, else False.

    Args:
        lists: the lists to begin with.

    Attributes:
        lists: the current lists; assign others to replace them. A host may connect if all of them permit it; with no
            list, every host may.
    """

    def __init__(self, lists: Iterable[AddressList] = ()) -> None:
        self.lists: tuple[AddressList, ...] = tuple(lists)

    def __call__(self, host: str) -> bool:
        return all(permits(host) for permits in self.lists)


class AccessInForce:
    """The access rules that a running service applies to its server: policy and address lists, replaced at a reload.

    Args:
        configuration: the configuration with which the service starts.
        overrides: command-line options that replace parts of the configuration.

    Attributes:
        rules: the access rules in force; None without a policy.
        allow_list: tells which hosts may connect to any listener; a listener can have a further list of its own.
        is_guarded: whether the server is given a policy, so that it can be replaced later; set by `guard`.
        read_only: URLs of the listeners that are read-only because there is no policy; set by `replace_policy`, once
            the listeners are bound.
    """

    def __init__(self, configuration: DeclaredServer, overrides: Overrides) -> None:
        self._overrides = overrides
        self.rules: AccessRules | None = overrides.rules(configuration)
        self.allow_list: ReloadableAllowList = ReloadableAllowList()
        self.is_guarded: bool = False
        self.read_only: tuple[str, ...] = ()
        self._allow_lists: dict[str, ReloadableAllowList] = {}  # of single listeners, by URL

    def guard(self, listeners: Sequence[Listener]) -> Policy | None:
        """Put the access rules into force before the start, and return the policy to start the server with.

        Sets `is_guarded` and the lists of `allow_list`.

        Args:
            listeners: the listeners with which the server starts.

        Returns:
            None if the server needs no policy: there are no rules, nothing can be reloaded, and the network does not
            reach a listener.
        """
        self.allow_list.lists = self._lists(self.rules)
        self.is_guarded = (
            self.rules is not None
            or self._overrides.can_reload
            or any(reaches_network(str(one.endpoint)) for one in listeners)
        )
        return self.cautious_policy(self.rules)

    def cautious_policy(self, rules: AccessRules | None) -> Policy | None:
        """Return a policy for the time until the listeners are bound.

        Args:
            rules: the access rules, which give the policy. None: all network listeners are read-only, even those that
                no other host can reach, unless writes were allowed on the command line.

        Returns:
            None if the server needs no policy: ``is_guarded`` is False.
        """
        return self._policy(rules, NETWORK_SCHEMES) if self.is_guarded else None

    def replace_policy(self, server: RunningServer, rules: AccessRules | None) -> None:
        """Give a running server, whose listeners are bound, the policy of other access rules, from the next request on.

        With ``rules`` None there is no policy: listeners that other hosts can reach become read-only, unless writes
        were allowed on the command line. Also sets `rules` and `read_only`. Call this only if `is_guarded`: a server
        that was created without a policy refuses one.
        """
        self.rules = rules
        exposed = [url for url in server.endpoints if reaches_network(url)]
        self.read_only = () if rules is not None or self._overrides.allow_writes else tuple(exposed)
        server.replace_policy(self._policy(rules, exposed))

    def replace_lists(self, new: DeclaredServer, rules: AccessRules | None) -> bool:
        """Replace all address lists by the lists of a new configuration; open connections are not ended.

        Args:
            new: the new configuration, with the lists of single listeners.
            rules: the new access rules, with the list for all listeners; None without a policy.

        Returns:
            True if the list of a single listener has changed; the list for all listeners does not count.
        """
        self.allow_list.lists = self._lists(rules)
        changed = False
        for one in new.listeners:
            allow_list = self._allow_lists.get(str(one.endpoint))
            if allow_list is not None and isinstance(one.access, AddressList) and allow_list.lists != (one.access,):
                allow_list.lists = (one.access,)
                changed = True
        if "listener" in new.at_once:  # a listener that comes back later begins with the list that it has then
            there = {str(one.endpoint) for one in new.listeners}
            self._allow_lists = {url: each for url, each in self._allow_lists.items() if url in there}
        return changed

    def listeners(self, configuration: DeclaredServer) -> list[Listener]:
        """Return the listeners of a configuration, with address lists that `replace_lists` can replace later.

        If the command line gives listeners, these are returned instead; they have no list of their own.
        """
        found = []
        for one in self._overrides.listeners_of(configuration):
            if isinstance(one.access, AddressList):
                # The same object every time: a listener does not count as changed because its list has.
                allow_list = self._allow_lists.setdefault(str(one.endpoint), ReloadableAllowList((one.access,)))
                one = replace(one, access=allow_list)
            found.append(one)
        return found

    def _policy(self, rules: AccessRules | None, exposed: Sequence[str]) -> Policy:
        """Return the policy of the access rules; without rules, a policy that makes some listeners read-only.

        ``exposed`` has the URLs of the listeners to make read-only, or beginnings of URLs. If the command line allows
        writes, no listener becomes read-only.
        """
        if rules is not None:
            return rules.policy
        return read_only_for(() if self._overrides.allow_writes else exposed)

    def _lists(self, rules: AccessRules | None) -> tuple[AddressList, ...]:
        own = () if self._overrides.addresses is None else (self._overrides.addresses,)
        return own if rules is None else (*own, rules.addresses)

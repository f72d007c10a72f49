"""Rules of a policy in their order: which clients and requests each applies to, and what it does (clauses M6, T15).

Knows the texts of rules; knows no connection and no store. `busway.access.rule_evaluation` decides by the rules: the
first that applies decides.

1. A denied request is answered with exception 01; a rule about items that names no role may choose 02, as if the items
   did not exist.
2. ``read-only`` permits reads and denies writes. A rule that names tables, items or files never fits a request that
   touches neither items nor files.
3. Limits apply to writes of holding registers. A write of unknown values is denied where limits apply; function 22 is
   decided by the value it would write if that is known, else by all values that its masks permit.
4. No role and no right is built in: a request that no rule covers is decided by the default.
"""

import struct
from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum
from types import NoneType
from typing import Final, TypeVar

from ..codes import ExceptionCode, Table
from ..errors import ConfigError
from ..options import declaration
from ..options.endpoints import SCHEMES, parse_endpoint
from ..options.networks import NetworkIndex, Networks
from ..values.unfit_values import shown
from .access_request import END, FILES, AccessSubject, Space
from .addresses import AddressList
from .notation import Function, NumberRange, parse_files, parse_functions, parse_items, parse_table, parse_units

EVERYWHERE: Final[tuple[NumberRange, ...]] = ((0, END),)
RATES: Final = declaration.Range(0.001, 1_000_000)
"""Valid rates of a rule: requests per second and host."""
DEFAULT_RULE: Final = "default"
"""What logs name as the rule if no rule applied and the policy's default decided; no rule may have this name."""
_NOWHERE: Final[tuple[NumberRange, ...]] = ()
_EMPTY: Final = "is empty, so the rule would never fit; leave it out"
EnumValue = TypeVar("EnumValue", bound=Enum)


class Action(Enum):
    """What a rule or the policy's default does with a request: allow it, deny it, or allow it if it is a read."""

    ALLOW = "allow"
    DENY = "deny"
    READ_ONLY = "read-only"

    def permits(self, writes: bool) -> bool:
        """Whether this action permits a write, if ``writes`` is True, or a read, if it is False."""
        return self is Action.ALLOW or (self is Action.READ_ONLY and not writes)


class AccessKind(Enum):
    """Which requests an access rule applies to: reads, writes or both."""

    READ = "read"
    WRITE = "write"
    ANY = "any"

    def fits(self, writes: bool) -> bool:
        """Whether a rule of this kind applies to a write, if ``writes`` is True, or to a read, if it is False."""
        return self is AccessKind.ANY or (self is AccessKind.WRITE) == writes


@dataclass(frozen=True, slots=True)
class Limits:
    """The lowest and highest value that an access rule lets clients write to a register.

    Attributes:
        low, high: the lowest and highest value, 0…65535, or -32768…32767 if ``signed``.
        signed: whether registers are read as numbers with a sign.

    Raises:
        ConfigError: a value that no register can hold, or ``low`` above ``high``.
    """

    low: int
    high: int
    signed: bool = False

    def __post_init__(self) -> None:
        least, most = (-0x8000, 0x7FFF) if self.signed else (0, 0xFFFF)
        for value in (self.low, self.high):
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise ConfigError(f"a register holds {least}…{most}, not {shown(value)}", key="values")
        if self.low > self.high:
            raise ConfigError(f"nothing is between {self.low} and {self.high}", key="values")

    def permit(self, register: int) -> bool:
        """Whether a register value, 0…65535, is within the limits.

        With ``signed`` it is first read as a number with a sign.
        """
        return self.low <= self._number(register) <= self.high

    def permit_all(self, registers: bytes) -> bool:
        """Whether all register values are within the limits; ``registers``: one or more, two big-endian bytes each."""
        numbers = struct.unpack(f">{len(registers) // 2}{'h' if self.signed else 'H'}", registers)
        least: int = min(numbers)
        most: int = max(numbers)
        return self.low <= least and most <= self.high

    def permit_masks(self, and_mask: int, or_mask: int) -> bool:
        """Whether the result of a mask write (function 22) is within the limits, whatever the register holds.

        Both masks are 0…65535.
        """
        fixed = or_mask & ~and_mask & 0xFFFF
        least, most = fixed, fixed | and_mask
        if self.signed and and_mask & 0x8000:  # the sign is free: least with it, most without
            least, most = fixed | 0x8000, most & 0x7FFF
        return self.permit(least) and self.permit(most)

    def _number(self, register: int) -> int:
        return register - 0x10000 if self.signed and register & 0x8000 else register


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """One rule of an access policy: the clients and requests it applies to, and what it does.

    A field that is left out (None, or empty) excludes nothing. `Rule.of` takes the texts that people write.

    Attributes:
        name: its name in logs; a policy numbers rules without a name.
        action: what happens to the requests that it applies to.
        peers: hosts of the clients; None for all. An empty set is refused, like that of roles, units and functions.
        roles: roles of the clients' certificates; a client without a role has none of them. None: with or without one.
        listeners: URLs of listeners, or schemes (``tls://``); empty for all.
        units: the units asked, 0…255; None for all.
        functions: function codes, each with a sub-function or with None for all its sub-functions; None for all.
        items: ranges (first, end) of items by table, ``end`` not included. If ``items`` and ``files`` are both empty,
            the rule is for requests for any items or files, or none.
        files: ranges (first, end) of file numbers, ``end`` not included.
        access: reads, writes, or both.
        limits: the values that may be written to holding registers; None for all values.
        rate: requests per second that each host may send by this rule, 0.001…1000000; more are answered with exception
            06. None: no limit.
        code: exception code of a refusal: 1, or 2 for a rule with ``items`` and without ``roles``.

    Raises:
        ConfigError: a field is empty, out of range or of another type, or fields do not go together; its key names the
            field.
    """

    name: str = ""
    action: Action = Action.ALLOW
    peers: Networks | None = None
    roles: frozenset[str] | None = None
    listeners: tuple[str, ...] = ()
    units: frozenset[int] | None = None
    functions: frozenset[Function] | None = None
    items: Mapping[Table, tuple[NumberRange, ...]] = field(default_factory=dict, hash=False)
    files: tuple[NumberRange, ...] = ()
    access: AccessKind = AccessKind.ANY
    limits: Limits | None = None
    rate: float | None = None
    code: int = ExceptionCode.ILLEGAL_FUNCTION

    def __post_init__(self) -> None:
        _check_types(self)
        if self.code not in (ExceptionCode.ILLEGAL_FUNCTION, ExceptionCode.ILLEGAL_DATA_ADDRESS):
            raise ConfigError(f"a refusal is answered with 1 or 2, not {shown(self.code)}", key="code")
        if self.code == ExceptionCode.ILLEGAL_DATA_ADDRESS and (not self.items or self.roles is not None):
            raise ConfigError("2 is for rules that name a table or addresses and no role; leave it out", key="code")
        if self.limits is not None and (self.action is not Action.ALLOW or self.access is AccessKind.READ):
            raise ConfigError("limits are for writes that a rule allows", key="values")
        if self.limits is not None and self.items and Table.HOLDING_REGISTERS not in self.items:
            raise ConfigError("limits are for holding registers", key="values")
        if self.rate is not None:
            if isinstance(self.rate, bool) or not RATES.has(self.rate):
                raise ConfigError(f"requests per second are {RATES}, not {shown(self.rate)}", key="rate")
            if self.action is Action.DENY:
                raise ConfigError("a rule that denies lets nothing through", key="rate")
        for key, given in (("peers", self.peers), ("roles", self.roles), ("units", self.units)):
            if given is not None and not given:
                raise ConfigError(_EMPTY, key=key)
        if self.functions is not None and not self.functions:
            raise ConfigError(_EMPTY, key="functions")

    @classmethod
    def of(
        cls,
        *,
        name: str = "",
        action: str | Action = Action.ALLOW,
        peers: Iterable[str] | Networks | None = None,
        roles: Iterable[str] | None = None,
        listeners: Iterable[str] | None = None,
        units: str | int | Iterable[str | int] | None = None,
        functions: str | int | Iterable[str | int] | None = None,
        table: str | Table | Iterable[str | Table] | None = None,
        addresses: str | int | Iterable[str | int] | None = None,
        files: str | int | Iterable[str | int] | None = None,
        access: str | AccessKind = AccessKind.ANY,
        values: tuple[int, int] | Limits | None = None,
        signed: bool = False,
        rate: float | None = None,
        code: int = ExceptionCode.ILLEGAL_FUNCTION,
    ) -> "Rule":
        """Build an access rule from texts as people write them in files.

        Args:
            name: name of the rule in logs.
            action: ``allow``, ``deny`` or ``read-only``.
            peers: addresses and networks of the clients, ``["10.0.0.0/8"]``.
            roles: roles of the clients' certificates.
            listeners: URLs of listeners, or schemes such as ``tls://``.
            units: ``"1-5,7"``, 0…255.
            functions: codes, names and groups, ``["read", 16, "8/1"]`` (`busway.access.notation`).
            table: ``holding``, ``input``, ``coil``, ``discrete``, or several; without ``addresses`` the whole tables.
            addresses: items, ``"4x101-4x200"``; with one table also offsets, ``"100-199"``; not with several tables.
            files: numbers of files, ``"1-4"``.
            access: ``read``, ``write`` or ``any``.
            values: the lowest and highest value that may be written to a holding register; None for all values.
            signed: whether ``values`` are numbers with a sign; ignored if they are `Limits`.
            rate: requests per second and host, 0.001…1000000; None for no limit.
            code: exception code of a refusal: 1, or 2 for a rule that names tables or addresses and no roles.

        Raises:
            ConfigError: an argument is invalid, or an empty list; its key names it.
        """
        if isinstance(values, Limits) or values is None:
            limits = values
        elif isinstance(values, tuple) and len(values) == 2:
            limits = Limits(*values, signed=signed)
        else:
            raise ConfigError(f"a pair (low, high) is needed, not {shown(values)}", key="values")
        given_units = given_functions = given_files = None
        if units is not None:
            with _about("units"):
                given_units = parse_units(units)
        if functions is not None:
            with _about("functions"):
                given_functions = parse_functions(functions)
        if files is not None:
            with _about("files"):
                given_files = parse_files(files)
                if not given_files:
                    raise ConfigError(_EMPTY)
        given_listeners = () if listeners is None else tuple(map(listener_name, _texts(listeners, "listeners")))
        if listeners is not None and not given_listeners:
            raise ConfigError(_EMPTY, key="listeners")
        return cls(
            name=name,
            action=_one_of(Action, action, "action"),
            peers=peers if peers is None or isinstance(peers, Networks) else Networks(peers, key="peers"),
            roles=None if roles is None else frozenset(_texts(roles, "roles")),
            listeners=given_listeners,
            units=given_units,
            functions=given_functions,
            items=_items(table, addresses),
            files=given_files or (),
            access=_one_of(AccessKind, access, "access"),
            limits=limits,
            rate=rate,
            code=code,
        )

    def is_for(self, subject: AccessSubject) -> bool:
        """Whether the rule applies to a client: its host, role and listener are among those that the rule names.

        True does not mean that the rule applies to a request: its units, functions and items are not looked at.
        """
        return (
            (self.peers is None or subject.host in self.peers)
            and (self.roles is None or subject.role in self.roles)
            and (not self.listeners or any(_is_listener(each, subject) for each in self.listeners))
        )

    def names(self, function: int, sub_function: int | None) -> bool:
        """Whether the rule applies to a function: it lists the code, alone or with the sub-function, or no functions.

        A ``sub_function`` of None (none, or truncated) matches only a code that is listed with all its sub-functions.
        """
        if self.functions is None:
            return True
        return (function, None) in self.functions or (
            sub_function is not None and (function, sub_function) in self.functions
        )

    def ranges(self, space: Space) -> tuple[NumberRange, ...]:
        """Return the items of a table, or the file numbers, that the rule applies to, as ascending ranges.

        One range with all addresses if the rule names neither items nor files; empty if it names only items or files
        outside ``space``, so always if ``space`` is None (neither a table nor files).
        """
        if not self.items and not self.files:
            return EVERYWHERE
        if isinstance(space, Table):
            return self.items.get(space, _NOWHERE)
        return self.files if space == FILES else _NOWHERE


@dataclass(frozen=True, slots=True)
class Policy:
    """An access policy: ordered rules, of which the first that applies decides, and a default. It cannot be changed.

    Args:
        rules: the rules; the first that applies to a request decides.
        default: what happens to requests that no rule applies to; if left out, they are denied.

    Raises:
        ConfigError: two rules have the same name, a rule has the reserved name ``default``, or ``default`` is no
            `Action`.
    """

    rules: tuple[Rule, ...] = ()
    default: Action = Action.DENY
    _by_peer: tuple[tuple[int, ...], NetworkIndex] | None = field(init=False, default=None, repr=False, compare=False)
    """Positions of the rules without ``peers``, and an index by host of the other rules.

    None until `prepare` was called.
    """

    def __post_init__(self) -> None:
        if not isinstance(self.default, Action):
            raise ConfigError(f"must be an Action, not {shown(self.default)}; Policy.of takes texts", key="default")
        named = tuple(
            rule if rule.name else replace(rule, name=f"rule {number}") for number, rule in enumerate(self.rules, 1)
        )
        taken = {DEFAULT_RULE}
        for rule in named:
            if rule.name in taken:
                raise ConfigError(f"the name {shown(rule.name)} is taken", key="name")
            taken.add(rule.name)
        object.__setattr__(self, "rules", named)

    @classmethod
    def of(cls, *rules: Rule, default: str | Action = Action.DENY) -> "Policy":
        """Create a policy of rules in their order.

        Args:
            rules: the rules; the first that applies to a request decides.
            default: ``allow``, ``deny`` or ``read-only``, for requests that no rule applies to.

        Raises:
            ConfigError: there is no such default, two rules have the same name, or a rule is named ``default``.
        """
        return cls(rules, _one_of(Action, default, "default"))

    @classmethod
    def read_only(cls) -> "Policy":
        """Return a policy without rules: every client may read, none may write."""
        return cls(default=Action.READ_ONLY)

    @classmethod
    def allow_all(cls) -> "Policy":
        """Return a policy without rules that permits everything, like a server without a policy."""
        return cls(default=Action.ALLOW)

    def prepare(self) -> None:
        """Create the index of the rules by client host now, instead of at the first request.

        That takes 0.1 s for 100 000 rules. A second call does nothing.
        """
        if self._by_peer is None:
            of_all_peers = tuple(number for number, rule in enumerate(self.rules) if rule.peers is None)
            index = NetworkIndex(
                (number, rule.peers) for number, rule in enumerate(self.rules) if rule.peers is not None
            )
            object.__setattr__(self, "_by_peer", (of_all_peers, index))

    def rules_for(self, subject: AccessSubject) -> tuple[Rule, ...]:
        """Return the rules that apply to one client, by host, role and listener, in their order."""
        self.prepare()
        assert self._by_peer is not None  # that is what was prepared
        of_all_peers, index = self._by_peer
        own = index.find(subject.host)
        numbers = sorted([*of_all_peers, *own]) if own else of_all_peers
        rules = [self.rules[number] for number in numbers]
        return tuple(rule for rule in rules if rule.is_for(subject))


@dataclass(frozen=True, slots=True)
class AccessRules:
    """The access rules of a configuration file: its policy and its address list.

    Attributes:
        policy: which requests are permitted.
        addresses: which hosts may connect.
    """

    policy: Policy
    addresses: AddressList


_TYPES: Final[tuple[tuple[str, type | tuple[type, ...], str], ...]] = (
    ("action", Action, "an Action"),
    ("access", AccessKind, "an AccessKind"),
    ("peers", (Networks, NoneType), "Networks"),
    ("roles", (Set, NoneType), "a frozenset of texts"),
    ("listeners", tuple, "a tuple of texts"),
    ("units", (Set, NoneType), "a frozenset of numbers"),
    ("functions", (Set, NoneType), "a frozenset of pairs"),
    ("items", Mapping, "a mapping of tables"),
    ("files", tuple, "a tuple of ranges"),
    ("limits", (Limits, NoneType), "Limits"),
)
"""Fields of a rule with their types, and these in words."""


def _check_types(rule: Rule) -> None:
    """Raise `ConfigError` if a field of a rule has another type than it is declared with.

    With texts instead (``functions=frozenset({"write"})``) a rule that denies would never apply, or every request fail.
    """
    for key, kind, words in _TYPES:
        given = getattr(rule, key)
        if not isinstance(given, kind):
            name = "values" if key == "limits" else key
            raise ConfigError(f"must be {words}, not {shown(given)}; Rule.of takes texts", key=name)
    for key, is_right, words in (
        ("roles", rule.roles is None or all(isinstance(role, str) for role in rule.roles), "texts"),
        ("listeners", all(map(_is_listener_name, rule.listeners)), "URLs in small letters, or schemes such as tls://"),
        ("units", rule.units is None or all(map(_is_unit, rule.units)), "numbers 0…255"),
        (
            "functions",
            rule.functions is None or all(map(_is_function, rule.functions)),
            "pairs such as (8, 1), (6, None)",
        ),
        ("items", all(map(_is_of_table, rule.items.items())), "ranges (first, end) by Table"),
        ("files", all(map(_is_range, rule.files)), "ranges (first, end)"),
    ):
        if not is_right:
            raise ConfigError(f"must be {words}, not {shown(getattr(rule, key))}; Rule.of takes texts", key=key)


def _is_listener_name(value: object) -> bool:
    if not isinstance(value, str):
        return False
    scheme, separator, _ = value.partition("://")
    return bool(separator) and scheme in SCHEMES


def _is_unit(value: object) -> bool:
    return isinstance(value, int) and 0 <= value <= 255


def _is_function(value: object) -> bool:
    return (
        isinstance(value, tuple)
        and len(value) == 2
        and isinstance(value[0], int)
        and (value[1] is None or isinstance(value[1], int))
    )


def _is_of_table(value: tuple[object, object]) -> bool:
    table, ranges = value
    return isinstance(table, Table) and isinstance(ranges, tuple) and bool(ranges) and all(map(_is_range, ranges))


def _is_range(value: object) -> bool:
    if not isinstance(value, tuple) or len(value) != 2:
        return False
    first, end = value
    return isinstance(first, int) and isinstance(end, int) and 0 <= first < end


def _items(
    table: str | Table | Iterable[str | Table] | None, addresses: str | int | Iterable[str | int] | None
) -> dict[Table, tuple[NumberRange, ...]]:
    tables: list[Table] = []
    if table is not None:
        with _about("table"):
            tables = [parse_table(each) for each in ([table] if isinstance(table, str | Table) else table)]
            if not tables:
                raise ConfigError(_EMPTY)
    if addresses is None:
        return dict.fromkeys(tables, EVERYWHERE)
    with _about("addresses"):
        if len(tables) > 1:
            raise ConfigError("addresses go with one table")
        items = parse_items(addresses, tables[0] if tables else None)
        if not items:
            raise ConfigError(_EMPTY)
        return items


def _texts(values: Iterable[str], key: str) -> tuple[str, ...]:
    if isinstance(values, str):
        raise ConfigError(f"a list of texts is needed, not {shown(values)}", key=key)
    found = tuple(values)
    for each in found:
        if not isinstance(each, str) or not each:
            raise ConfigError(f"a list of texts is needed, and {shown(each)} is none", key=key)
    return found


def listener_name(text: str) -> str:
    """Return the name of a listener in its normal form: a URL without options, or a scheme alone such as ``tls://``.

    Raises:
        ConfigError: the text is neither of them.
    """
    scheme, separator, rest = text.partition("://")
    if separator and not rest and scheme.lower() in SCHEMES:
        return f"{scheme.lower()}://"
    with _about("listeners"):
        return parse_endpoint(text).url


def _is_listener(wanted: str, subject: AccessSubject) -> bool:
    if wanted == subject.listener or wanted in subject.listener_names:
        return True
    return wanted.endswith("://") and subject.listener.startswith(wanted)


@contextmanager
def _about(key: str) -> Iterator[None]:
    """Context manager that sets ``key`` in a `ConfigError` raised inside it; the key names the wrong argument."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(error.message, key=key) from error


def _one_of(kind: type[EnumValue], value: "str | EnumValue", key: str) -> EnumValue:
    try:
        return kind(value)
    except ValueError:
        known = ", ".join(str(each.value) for each in kind)
        raise ConfigError(f"one of {known} is needed, not {shown(value)}", key=key) from None

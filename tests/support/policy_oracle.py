"""What a policy permits, evaluated a second time: written from docs/security.md, sharing no code with `busway.access`.

Knows bytes of PDUs and rules as they are documented. Must not import the evaluator that it judges.

1. A request touches items (ranges of a table, files, or none). For each item the first rule that fits decides.
2. Where the documentation leaves a case open, the verdict says so (``open``), and both answers are right.
3. A rate is a bucket of one second's requests. The server's clock is not known exactly, so a bucket is two:
   the most and the least that it may hold.
"""

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from ipaddress import ip_address, ip_network
from itertools import pairwise

HOLDING, INPUT, COIL, DISCRETE, FILE, NOTHING = "holding", "input", "coil", "discrete", "file", "nothing"
READS = {1: COIL, 2: DISCRETE, 3: HOLDING, 4: INPUT, 24: HOLDING}
WRITES = {5: COIL, 6: HOLDING, 15: COIL, 16: HOLDING, 22: HOLDING, 23: HOLDING}
WRITING_FUNCTIONS = frozenset({5, 6, 15, 16, 21, 22, 23})
GROUPS = {
    "read": frozenset({1, 2, 3, 4, 20, 24}),
    "write": WRITING_FUNCTIONS,
    "diagnostics": frozenset({7, 8, 11, 12, 17}),
}
CHANGING_SUB_FUNCTIONS = frozenset({1, 3, 4, 0x0A, 0x14})
KNOWN = GROUPS["read"] | GROUPS["write"] | GROUPS["diagnostics"] | {43}


@dataclass(frozen=True)
class Masks:
    """What function 22 does to a register."""

    keep: int
    set: int

    def of(self, value: int) -> int:
        """The register afterwards."""
        return (value & self.keep) | (self.set & ~self.keep & 0xFFFF)

    def every_result(self) -> tuple[int, ...]:
        """Results that hold the least and the greatest number, without and with a sign."""
        base = self.set & ~self.keep & 0xFFFF
        sign = self.keep & 0x8000
        return (base, base | self.keep, base | sign, base | (self.keep & 0x7FFF))


@dataclass(frozen=True)
class Touched:
    """A range of items that a request touches.

    Attributes:
        values: of a write of registers, one each; None where they are not known.
    """

    space: str
    first: int
    last: int
    writes: bool
    values: tuple[int, ...] | Masks | None = None


@dataclass(frozen=True)
class Asked:
    """A request as its bytes say."""

    function: int
    sub_function: int | None
    touched: tuple[Touched, ...]
    malformed: bool = False
    open: bool = False


@lru_cache(1 << 14)
def asked(pdu: bytes) -> Asked:
    """What a PDU touches."""
    function, body = pdu[0], pdu[1:]
    if function in (8, 43):
        size = 2 if function == 8 else 1
        sub = int.from_bytes(body[:size], "big") if len(body) >= size else None
        return Asked(
            function, sub, (Touched(NOTHING, 0, 0, False),), open=sub is None or (function, len(body)) == (8, 2)
        )
    if function in (20, 21):
        return _files(function, body)
    if function not in READS and function not in WRITES:
        return Asked(function, None, (Touched(NOTHING, 0, 0, False),))
    try:
        found = _well_formed(function, body)
    except struct.error:
        found = None
    if found is not None:
        return Asked(function, None, found, open=any(one.last > 0xFFFF for one in found))
    whole = []
    if function in READS or function in (22, 23):
        whole.append(Touched(READS.get(function, HOLDING), 0, 0xFFFF, False))
    if function in WRITES:
        whole.append(Touched(WRITES[function], 0, 0xFFFF, True))
    return Asked(function, None, tuple(whole), malformed=True)


def _well_formed(function: int, body: bytes) -> tuple[Touched, ...] | None:
    """The ranges; None where the request breaks a rule of its function. May raise `struct.error`."""
    if function == 24:
        (address,) = struct.unpack(">H", body)
        return (Touched(HOLDING, address, address, False),)
    if function in READS:
        address, count = struct.unpack(">HH", body)
        most = 2000 if function in (1, 2) else 125
        return (Touched(READS[function], address, address + count - 1, False),) if 1 <= count <= most else None
    if function == 5:
        address, value = struct.unpack(">HH", body)
        return (Touched(COIL, address, address, True, (value,)),) if value in (0, 0xFF00) else None
    if function == 6:
        address, value = struct.unpack(">HH", body)
        return (Touched(HOLDING, address, address, True, (value,)),)
    if function == 22:
        address, keep, put = struct.unpack(">HHH", body)
        return (Touched(HOLDING, address, address, False), Touched(HOLDING, address, address, True, Masks(keep, put)))
    if function == 15:
        address, count, size = struct.unpack(">HHB", body[:5])
        if not 1 <= count <= 1968 or size != (count + 7) // 8 or len(body) != 5 + size:
            return None
        bits = int.from_bytes(body[5:], "little")
        return (Touched(COIL, address, address + count - 1, True, tuple((bits >> n) & 1 for n in range(count))),)
    head = 9 if function == 23 else 5
    address, count, size = struct.unpack(">HHB", body[head - 5 : head])
    if not 1 <= count <= (121 if function == 23 else 123) or size != 2 * count or len(body) != head + size:
        return None
    values = struct.unpack(f">{count}H", body[head:])
    written = Touched(HOLDING, address, address + count - 1, True, values)
    if function == 16:
        return (written,)
    first, number = struct.unpack(">HH", body[:4])
    return (Touched(HOLDING, first, first + number - 1, False), written) if 1 <= number <= 125 else None


def _files(function: int, body: bytes) -> Asked:
    records, rest = [], body[1:]
    while len(rest) >= 7:
        _, file, _, count = struct.unpack(">BHHH", rest[:7])
        rest = rest[7 + (2 * count if function == 21 else 0) :]
        records.append(Touched(FILE, file, file, function == 21))
    return Asked(function, None, tuple(records))


@dataclass(frozen=True)
class ModelRule:
    """A rule, in the words of the documentation; None fits all."""

    name: str
    action: str = "allow"
    peers: tuple[str, ...] | None = None
    roles: tuple[str, ...] | None = None
    listeners: tuple[str, ...] | None = None
    units: frozenset[int] | None = None
    functions: tuple[int | str, ...] | None = None
    items: tuple[tuple[str, int, int], ...] = ()
    files: frozenset[int] = frozenset()
    access: str = "any"
    values: tuple[int, int] | None = None
    signed: bool = False
    rate: float | None = None
    code: int = 1


@dataclass(frozen=True)
class ModelPolicy:
    """Rules in their order, and what holds where none fits."""

    rules: tuple[ModelRule, ...]
    default: str


@dataclass(frozen=True)
class Asker:
    """Who asks, and where."""

    host: str
    listener: str
    role: str | None = None


@dataclass
class Verdict:
    """What a policy says of a request, rates aside.

    Attributes:
        denials: exception code and rule of each item that is denied.
        charged: rules with a rate that decide an item.
        deciding: all rules that decide an item.
        open: the documentation does not decide this case.
    """

    denials: set[tuple[int, str]] = field(default_factory=set)
    charged: dict[str, float] = field(default_factory=dict)
    deciding: set[str] = field(default_factory=set)
    open: bool = False


def judge(
    policy: ModelPolicy,
    asker: Asker,
    units: Iterable[int],
    pdu: bytes,
    registers: Mapping[int, int] | None = None,
) -> Verdict:
    """What ``policy`` says.

    Args:
        units: the unit asked, and those that its device is listed as.
        registers: what the holding registers hold, for function 22; None behind a gateway.
    """
    request = asked(pdu)
    verdict = Verdict(open=request.open)
    known = frozenset(units)
    rules = [rule for rule in policy.rules if _is_for(rule, asker, known, request)]
    for touched in request.touched:
        for first, last in _parts(touched, rules):
            _judge_part(rules, policy.default, request, touched, first, last, registers, verdict)
    return verdict


def _is_for(rule: ModelRule, asker: Asker, units: frozenset[int], request: Asked) -> bool:
    if rule.peers is not None and not any(_is_in(asker.host, one) for one in rule.peers):
        return False
    if rule.roles is not None and asker.role not in rule.roles:
        return False
    if rule.listeners is not None and not any(
        asker.listener == one or (one.endswith("://") and asker.listener.startswith(one)) for one in rule.listeners
    ):
        return False
    if rule.units is not None and not rule.units & units:
        return False
    return rule.functions is None or any(_names(one, request) for one in rule.functions)


@lru_cache(1 << 10)
def _is_in(host: str, network: str) -> bool:
    return ip_address(host) in ip_network(network)


def _names(named: int | str, request: Asked) -> bool:
    if isinstance(named, int):
        return named == request.function
    if "/" in named:
        function, sub = named.split("/")
        return (int(function), int(sub)) == (request.function, request.sub_function)
    return request.function in GROUPS[named]


def _parts(touched: Touched, rules: Iterable[ModelRule]) -> list[tuple[int, int]]:
    """The range, cut at every end of a rule's range, so that a rule fits a part or does not."""
    cuts = {touched.first, touched.last + 1}
    for rule in rules:
        for space, first, last in rule.items:
            if space == touched.space:
                cuts |= {cut for cut in (first, last + 1) if touched.first < cut <= touched.last}
    edges = sorted(cuts)
    return [(edge, following - 1) for edge, following in pairwise(edges)]


def _judge_part(
    rules: Iterable[ModelRule],
    default: str,
    request: Asked,
    touched: Touched,
    first: int,
    last: int,
    registers: Mapping[int, int] | None,
    verdict: Verdict,
) -> None:
    rule = next((one for one in rules if _fits(one, request, touched, first)), None)
    name, action, code = ("default", default, 1) if rule is None else (rule.name, rule.action, rule.code)
    verdict.deciding.add(name)
    if action == "deny" or (action == "read-only" and _is_change(request, touched)):
        verdict.denials.add((code, name))
        return
    if rule is None:
        return
    if rule.values is not None and not _within(rule, request, touched, first, last, registers, verdict):
        verdict.denials.add((code, name))
        return
    if rule.rate is not None:
        verdict.charged[name] = rule.rate


def _fits(rule: ModelRule, request: Asked, touched: Touched, first: int) -> bool:
    if rule.items or rule.files:
        if touched.space == NOTHING:
            return False
        if touched.space == FILE:
            if first not in rule.files:
                return False
        elif not any(space == touched.space and low <= first <= high for space, low, high in rule.items):
            return False
    if rule.access == "any":
        return True
    writes = _is_change(request, touched) if touched.space == NOTHING else touched.writes
    return writes == (rule.access == "write")


def _is_change(request: Asked, touched: Touched) -> bool:
    """Whether read-only denies this part; of 22 and 23 the part that reads is a read."""
    if touched.writes or touched.space != NOTHING:
        return touched.writes
    if request.function == 8:
        return request.sub_function in CHANGING_SUB_FUNCTIONS
    if request.function == 43:
        return request.sub_function == 13
    return request.function not in KNOWN


def _within(
    rule: ModelRule,
    request: Asked,
    touched: Touched,
    first: int,
    last: int,
    registers: Mapping[int, int] | None,
    verdict: Verdict,
) -> bool:
    assert rule.values is not None
    if touched.space == NOTHING:
        verdict.open = verdict.open or request.function not in KNOWN
        return True
    if touched.space != HOLDING or not touched.writes:
        return True
    values: Iterable[int]
    if touched.values is None:
        return False
    if isinstance(touched.values, Masks):
        if registers is None:
            values = touched.values.every_result()
        elif first in registers:
            values = (touched.values.of(registers[first]),)
        else:
            verdict.open = True  # a register that does not exist: its device refuses it in any case
            return True
    else:
        values = touched.values[first - touched.first : last - touched.first + 1]
    low, high = rule.values
    return all(low <= (one - 0x10000 if rule.signed and one >= 0x8000 else one) <= high for one in values)


class Bucket:
    """What is known of one host's rate by one rule."""

    def __init__(self, rate: float, now: float) -> None:
        self.rate = rate
        self.room = max(rate, 1.0)
        self.most = self.least = self.room
        self.seen = now

    def before(self, sent: float, answered: float) -> tuple[bool, bool]:
        """Whether a request between two moments may be permitted, and whether it may be refused."""
        most = min(self.room, self.most + max(0.0, answered - self.seen) * self.rate)
        return most >= 1 - 1e-6, self._least(sent) < 1 + 1e-6

    def after(self, sent: float, answered: float, permitted: bool) -> None:
        """Keep what became of a request between two moments."""
        refill = (answered - sent) * self.rate
        if permitted:
            most = min(self.room, self.most + max(0.0, sent - self.seen) * self.rate)
            self.most, self.least = min(self.room, most - 1 + refill), max(self._least(sent) - 1, 0.0)
        else:
            self.most, self.least = min(self.room, 1.0 + refill), min(self._least(sent), 1.0)
        self.seen = answered

    def doubt(self) -> None:
        """A request of which it is not known whether it was counted."""
        self.least = max(self.least - 1, 0.0)

    def forget(self) -> None:
        """Know nothing any more: the policy was replaced."""
        self.most, self.least = self.room, 0.0

    def _least(self, sent: float) -> float:
        return min(self.room, self.least + max(0.0, sent - self.seen) * self.rate)

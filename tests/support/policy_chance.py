"""Policies and requests by chance: rules whose ranges meet, and requests that end at, before and behind their edges.

Knows the oracle's rules and bytes; `rule_of` alone knows the library, to hand the same rules to it.
"""

import struct
from collections.abc import Sequence
from dataclasses import replace
from random import Random

from plain_device import SIZE
from policy_oracle import COIL, DISCRETE, FILE, HOLDING, INPUT, ModelPolicy, ModelRule

from busway.access.rules import Policy, Rule
from busway.errors import ConfigError

HOSTS = ("127.0.0.2", "127.0.0.3", "127.0.0.4")
PEERS = (("127.0.0.2/32",), ("127.0.0.2/31",), ("127.0.0.3/32", "127.0.0.4/32"), ("127.0.0.4/32",), ("127.0.0.0/8",))
FUNCTIONS: tuple[int | str, ...] = (
    *("read", "write", "diagnostics"),
    *(1, 2, 3, 3, 4, 5, 6, 15, 16, 16, 20, 21, 22, 23, 24, 7, 17, 43),
    *("8/0", "8/11", "8/1"),
)
SPACES = (HOLDING, HOLDING, HOLDING, COIL, COIL, INPUT, DISCRETE)
VALUES = (0, 1, 4, 5, 6, 99, 100, 101, 1000, 0x7FFF, 0x8000, 0xFFFF)
ODD = (
    *(b"\x07", b"\x08\x00\x00\x12\x34", b"\x08\x00\x0b\x00\x00", b"\x08\x00\x01\x00\x00", b"\x08\x00\x04\x00\x00"),
    *(b"\x0b", b"\x0c", b"\x11", b"\x2b\x0e\x01\x00", b"\x2b\x0e\x04\x00", b"\x2b\x0d\x00\x01\x02"),
    *(b"\x65abc", b"\x41", b"\x64\x00\x01\x00\x02", b"\x09\x00\x00"),
)
MALFORMED = (
    *(b"\x03\x00\x00\x00\x00", b"\x03\x00\x00\x00\x7e", b"\x03\x00\x00\x00", b"\x03\x00\x00\x00\x01\x00"),
    *(b"\x01\x00\x00\x07\xd1", b"\x06\x00\x01\x00", b"\x06\x00\x01\x00\x02\x03", b"\x05\x00\x01\x12\x34"),
    *(b"\x10\x00\x01\x00\x01\x04\x00\x01\x00\x02", b"\x10\x00\x01\x00\x02\x02\x00\x05", b"\x10\x00\x01\x00\x00\x00"),
    *(b"\x0f\x00\x00\x00\x09\x01\xff", b"\x16\x00\x01\x00\x00", b"\x17\x00\x00\x00\x01\x00\x01\x00\x02\x02\x00\x05"),
    *(b"\x03\xff\xff\x00\x02", b"\x10\xff\xff\x00\x02\x04\x00\x01\x00\x02"),
)


def rule_of(rule: ModelRule) -> Rule:
    """The same rule for the library. Raises `ConfigError` where it takes no such rule."""
    addresses = [f"{space}:{first}-{last}" for space, first, last in rule.items] or None
    return Rule.of(
        name=rule.name,
        action=rule.action,
        peers=rule.peers,
        roles=rule.roles,
        listeners=rule.listeners or (),
        units=None if rule.units is None else sorted(rule.units),
        functions=rule.functions,
        addresses=addresses,
        files=",".join(map(str, sorted(rule.files))) or None,
        access=rule.access,
        values=rule.values,
        signed=rule.signed,
        rate=rule.rate,
        code=rule.code,
    )


def policy_of(policy: ModelPolicy) -> Policy:
    """The same policy for the library."""
    return Policy.of(*map(rule_of, policy.rules), default=policy.default)


class Chance:
    """Makes policies and requests from one seed."""

    def __init__(self, seed: int, listeners: Sequence[str], units: Sequence[int]) -> None:
        self.random = Random(seed)
        self.listeners = listeners
        self._units = units
        self._names = 0

    def policy(self) -> ModelPolicy:
        """A policy of up to six rules."""
        rules = tuple(self._rule() for _ in range(self.random.randrange(7)))
        return ModelPolicy(rules, self.random.choice(("allow", "deny", "read-only")))

    def changed(self, policy: ModelPolicy) -> ModelPolicy:
        """A policy with a small difference: a rule more or less, another order or default, an edge moved by one."""
        rules = list(policy.rules)
        kind = self.random.randrange(6)
        if kind == 0 or not rules:
            return self.policy()
        if kind == 1:
            rules.pop(self.random.randrange(len(rules)))
        elif kind == 2:
            rules.insert(0, rules.pop())
        elif kind == 3:
            return ModelPolicy(policy.rules, self.random.choice(("allow", "deny", "read-only")))
        elif kind == 4:
            rules.insert(0, self._rule())
        else:
            rules = [self._moved(rule) for rule in rules]
        return ModelPolicy(tuple(rules), policy.default)

    def _rule(self) -> ModelRule:
        while True:
            rule = self._any_rule()
            try:
                rule_of(rule)
            except ConfigError:
                continue
            return rule

    def _moved(self, rule: ModelRule) -> ModelRule:
        items = tuple(
            (space, first, max(first, min(SIZE, last + self.random.choice((-1, 0, 1)))))
            for space, first, last in rule.items
        )
        return replace(rule, items=items)

    def _any_rule(self) -> ModelRule:
        random = self.random
        self._names += 1
        action = random.choices(("allow", "deny", "read-only"), (5, 4, 1))[0]
        items: tuple[tuple[str, int, int], ...] = ()
        if random.random() < 0.6:
            items = tuple(self._range(random.choice(SPACES)) for _ in range(random.choice((1, 1, 2, 3))))
        files = frozenset({random.choice((1, 2))}) if random.random() < 0.12 else frozenset()
        selective = bool(items or files)
        allows = action == "allow"
        return ModelRule(
            name=f"rule-{self._names}",
            action=action,
            peers=random.choice(PEERS) if random.random() < 0.5 else None,
            roles=random.choice((("operator",), ("viewer",))) if random.random() < 0.06 else None,
            listeners=tuple(random.sample(self.listeners, random.choice((1, 2)))) if random.random() < 0.2 else None,
            units=frozenset(random.sample(self._units, 1)) if random.random() < 0.25 else None,
            functions=tuple(random.sample(FUNCTIONS, random.choice((1, 2)))) if random.random() < 0.35 else None,
            items=items,
            files=files,
            access=random.choice(("read", "write")) if random.random() < (0.25 if selective else 0.1) else "any",
            values=random.choice(((0, 5), (5, 100), (100, 1000))) if allows and random.random() < 0.25 else None,
            rate=random.choice((2.0, 3.0, 5.0)) if allows and random.random() < 0.15 else None,
            code=2 if selective and action == "deny" and random.random() < 0.3 else 1,
        )

    def _range(self, space: str) -> tuple[str, int, int]:
        first = self.random.randrange(SIZE)
        return (space, first, min(SIZE - 1, first + self.random.choice((0, 1, 4, 9, 20))))

    def request(self, policy: ModelPolicy) -> tuple[int, bytes]:
        """A unit and a PDU that ask for something at an edge of a rule."""
        random = self.random
        unit = random.choice(self._units)
        kind = random.random()
        if kind < 0.12:
            return unit, random.choice(ODD)
        if kind < 0.18:
            return unit, random.choice(MALFORMED)
        ranges = [one for rule in policy.rules for one in rule.items] or [(HOLDING, 0, SIZE - 1)]
        space, first, last = random.choice(ranges) if random.random() < 0.8 else self._range(random.choice(SPACES))
        start = max(0, random.choice((first - 1, first, first, first + 1, last, last + 1, 0)))
        end = max(start, random.choice((first - 1, first, last - 1, last, last, last + 1, start, start)))
        return unit, self._ask(space, start, end - start + 1)

    def _ask(self, space: str, address: int, count: int) -> bytes:
        random = self.random
        count = min(count, 60)
        if random.random() < 0.08:
            space = FILE
        if space == FILE:
            return self._file()
        if space in (INPUT, DISCRETE) or random.random() < 0.5:
            function = {HOLDING: 3, INPUT: 4, COIL: 1, DISCRETE: 2}[space]
            return struct.pack(">BHH", function, address, count)
        if space == COIL:
            if count == 1 and random.random() < 0.6:
                return struct.pack(">BHH", 5, address, random.choice((0, 0xFF00)))
            size = (count + 7) // 8
            return struct.pack(">BHHB", 15, address, count, size) + random.getrandbits(count).to_bytes(size, "little")
        kind = random.random()
        if count == 1 and kind < 0.5:
            return struct.pack(">BHH", 6, address, random.choice(VALUES))
        if kind < 0.6:
            return struct.pack(">BHHH", 22, address, random.choice((0, 0xFFFF, 0x00FF, 0x7FFF)), random.choice(VALUES))
        if kind < 0.65:
            return struct.pack(">BH", 24, random.choice((5, address)))
        values = (
            [random.choice(VALUES) for _ in range(count)] if random.random() < 0.3 else [random.choice(VALUES)] * count
        )
        written = struct.pack(f">HHB{count}H", address, count, 2 * count, *values)
        if kind < 0.85:
            return b"\x10" + written
        return struct.pack(">BHH", 23, random.randrange(SIZE), random.choice((1, 2, 4))) + written

    def _file(self) -> bytes:
        parts = b""
        writes = self.random.random() < 0.5
        for _ in range(self.random.choice((1, 1, 2))):
            file, record, count = self.random.choice((1, 2, 3)), self.random.choice((0, 5, SIZE - 1)), 1
            parts += struct.pack(">BHHH", 6, file, record, count)
            if writes:
                parts += struct.pack(">H", self.random.choice(VALUES))
        return bytes((21 if writes else 20, len(parts))) + parts

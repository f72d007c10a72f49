"""No way round a policy on a gateway: a walk by chance that an oracle judges, and cases by name.

The oracle (`policy_oracle`) is written from docs/security.md alone. The record is that of the device
behind the gateway.
"""

import copy
import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from random import Random

import pytest
from plain_device import PlainDevice, RecordingServer, odd_reply
from policy_chance import HOSTS, Chance, policy_of
from policy_clients import connected
from policy_oracle import READS, WRITES, Asker, ModelPolicy, Verdict, asked, judge
from policy_walk import Judge, Tally, Walk

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.routes import Route, RoutingTable
from busway.observe.metrics.observer import MetricsObserver
from busway.options.tls import TlsParameters
from busway.server.listener import Listener
from busway.testing.certificates import CertificateFiles, CertificateStore

SEEDS = range(15)
SOAK_SEEDS = range(1000, 1200)
STEPS = 300
Units = Mapping[int, tuple[int, int]]
BROADCASTS = frozenset({5, 6, 15, 16, 21, 22})
SHIFT = 8
TRANSLATED = {1: (1, 0), 2: (2, 0), 3: (2, SHIFT), 4: (1, 0)}
"""Unit at the listener: unit behind, and what is added to addresses."""
AS_THEY_ARE = {unit: (unit, 0) for unit in range(1, 248)}


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> dict[str | None, CertificateFiles]:
    store = CertificateStore(tmp_path_factory.mktemp("certificates"))
    made: dict[str | None, CertificateFiles] = {role: store.client(role, role=role) for role in ("operator", "viewer")}
    return made | {None: store.server()}


class GatewayWorld:
    """A gateway before a server that keeps what it got, and plain devices as the model of those behind."""

    def __init__(self, gateway: Gateway, behind: RecordingServer, units: Units, audit: Path) -> None:
        self._gateway = gateway
        self._behind = behind
        self._units = units
        self._broadcasts = units is AS_THEY_ARE
        self._devices = copy.deepcopy(behind.devices)
        self._seen = len(behind.record)
        self._must: Counter[tuple[int, bytes]] = Counter()
        self._may: set[tuple[int, bytes]] = set()
        self._heard_broadcast = False
        self.line_units = frozenset({1, 2, 3, 4})
        self.audit = audit
        self.endpoints: Sequence[str] = gateway.endpoints

    def judge(self, policy: ModelPolicy, asker: Asker, unit: int, pdu: bytes) -> Verdict:
        """By the unit asked; a broadcast also by each unit that hears it. Unit 0 is the gateway itself, too."""
        if unit or asked(pdu).malformed:
            return judge(policy, asker, {unit}, pdu)
        verdict = Verdict()
        units = {0, 255}
        if pdu[0] in BROADCASTS:
            named = {unit for rule in policy.rules for unit in rule.units or ()}
            units = {0, *({*self._units} & {1, *named} if self._broadcasts else ())}
        for heard in units:
            one = judge(policy, asker, {heard}, pdu)
            verdict.denials |= one.denials
            verdict.charged |= one.charged
            verdict.deciding |= one.deciding
            verdict.open |= one.open
        return verdict

    def held(self, unit: int, space: str) -> list[int] | None:
        """A gateway does not know what a device holds."""
        return None

    def permitted(self, unit: int, pdu: bytes) -> bytes | None:
        """As the model of the device behind answers."""
        if unit == 0 and pdu[0] in BROADCASTS:
            self._heard_broadcast = self._broadcasts
            return None
        if unit not in self._units:
            return None if unit in (0, 255) else bytes((pdu[0] | 0x80, 0x0A))
        behind, shift = self._units[unit]
        request = asked(pdu)
        sent = shifted(pdu, shift)
        device = self._devices.get(behind)
        reply = bytes((pdu[0] | 0x80, 0x0B)) if device is None else device.execute(sent)
        if pdu[0] in READS or request.malformed:
            self._may |= {(behind, piece) for piece in (sent, *pieces(sent))}
        else:
            self._must[behind, sent] += 1
        if reply is None:
            return odd_reply(sent)
        return shifted(reply, -shift) if pdu[0] in (5, 6, 15, 16, 22) and not reply[0] & 0x80 else reply

    def refused(self, unit: int, pdu: bytes) -> None:
        """It may have arrived behind, if the device refused it."""
        if unit in self._units:
            behind, shift = self._units[unit]
            self._may.add((behind, shifted(pdu, shift)))

    def replace(self, policy: ModelPolicy) -> None:
        """At once."""
        self._gateway.replace_policy(policy_of(policy))

    def check(self, about: object) -> None:
        """What the devices got, and what they hold."""
        new = self._behind.record[self._seen :]
        self._seen += len(new)
        must, may, self._must, self._may = self._must, self._may, Counter(), set()
        if self._heard_broadcast:
            self._heard_broadcast = False
            self._devices = copy.deepcopy(self._behind.devices)
            return
        for one in new:
            if must[one]:
                must[one] -= 1
            else:
                assert one in may, f"arrived: unit {one[0]} {one[1].hex(' ')}: {about}"
        assert not +must, f"did not arrive: {+must}: {about}"
        assert self._behind.devices == self._devices, str(about)

    def hold(self) -> None:
        """Let devices wait."""
        self._behind.hold()

    def release(self) -> None:
        """Let them answer."""
        self._behind.release()


def shifted(pdu: bytes, shift: int) -> bytes:
    """A request, or the echo of a write, with other addresses."""
    if pdu[0] not in READS and pdu[0] not in WRITES:
        return pdu
    made = bytearray(pdu)
    for place in (1, 5) if pdu[0] == 23 else (1,):
        if len(pdu) >= place + 2:
            (address,) = struct.unpack_from(">H", pdu, place)
            struct.pack_into(">H", made, place, (address + shift) & 0xFFFF)
    return bytes(made)


def pieces(pdu: bytes) -> set[bytes]:
    """Reads that a longer one may be split into."""
    if pdu[0] not in (1, 2, 3, 4) or len(pdu) != 5:
        return set()
    address, count = struct.unpack(">HH", pdu[1:])
    most = 8 if pdu[0] in (1, 2) else 4
    return {struct.pack(">BHH", pdu[0], address + n, min(most, count - n)) for n in range(0, min(count, 2000), most)}


def routes(random: Random, units: Units) -> RoutingTable:
    """Units as they are; or 1 and 2 so, 3 as 2 with other addresses, 4 as 1 in small reads."""
    cache = random.choice((None, 60.0))
    if units is AS_THEY_ARE:
        return RoutingTable((Route(upstream="line", units=frozenset(units), cache=cache),))
    return RoutingTable(
        (
            Route(upstream="line", units=frozenset({1}), cache=cache),
            Route(upstream="line", units=frozenset({2}), cache=random.choice((None, 60.0))),
            Route(upstream="line", units=frozenset({3}), unit=2, shift=SHIFT, cache=cache),
            Route(upstream="line", units=frozenset({4}), unit=1, max_registers=4, max_bits=8, cache=cache),
        )
    )


async def walk(seed: int, steps: int, tmp_path: Path, certificates: Mapping[str | None, CertificateFiles]) -> Tally:
    """One walk over a gateway that is put together by chance."""
    random = Random(seed)
    one = PlainDevice()
    same = random.random() < 0.5
    units = random.choice((AS_THEY_ARE, TRANSLATED, TRANSLATED))
    urls = ["tcp://127.0.0.1:0", "tcp://127.0.0.1:0", "udp://127.0.0.1:0", "rtu+tcp://127.0.0.1:0"]
    listeners = [GatewayListener(f"listener {n}", Listener(url)) for n, url in enumerate(urls)]
    if random.random() < 0.3:
        files = certificates[None]
        tls = TlsParameters(certificate=str(files.certificate), key=str(files.key), authority=str(files.authority))
        listeners.append(GatewayListener("secure", Listener("tls://127.0.0.1:0", tls=tls)))
    path = tmp_path / f"{seed}.jsonl"
    audit = busway.AuditLog(path, interval=0, repeat_interval=0)
    async with RecordingServer({1: one, 2: one if same else PlainDevice()}) as behind:
        line = UpstreamSettings.of(
            "line",
            behind.url,
            share_reads=random.random() < 0.8,
            broadcast=units is AS_THEY_ARE,
            max_transactions=random.choice((1, 4)),
            same_device=(frozenset({1, 2}),) if same else (),
        )
        chance = Chance(seed, ("tcp://", "udp://", "rtu+tcp://", "tls://"), (1, 1, 1, 2, 3, 3, 4, 4, 0, 255, 9))
        policy = chance.policy()
        gateway = Gateway(
            GatewayPlan(tuple(listeners), (line,), routes(random, units)),
            policy=policy_of(policy),
            audit=audit,
            observers=[MetricsObserver()] if random.random() < 0.5 else [],
        )
        async with gateway, connected(gateway.endpoints, HOSTS, certificates) as clients:
            chance.listeners = (*chance.listeners, *gateway.endpoints[:2])
            judge_of_all = Judge(GatewayWorld(gateway, behind, units, path), policy, seed)
            try:
                return await Walk(judge_of_all.world, clients, chance, judge_of_all, one_unit_together=True).go(steps)
            finally:
                judge_of_all.close()
                audit.close()


@pytest.mark.parametrize("seed", SEEDS)
async def test_many_clients_with_different_rights_get_what_theirs_permit_and_nothing_else(
    seed: int, tmp_path: Path, certificates: dict[str | None, CertificateFiles]
) -> None:
    tally = await walk(seed, STEPS, tmp_path, certificates)
    assert min(tally.equal_bytes, tally.permitted, tally.denied) > 0


@pytest.mark.soak
@pytest.mark.parametrize("seed", SOAK_SEEDS)
async def test_long_walks_find_no_way_round(
    seed: int, tmp_path: Path, certificates: dict[str | None, CertificateFiles]
) -> None:
    await walk(seed, 5 * STEPS, tmp_path, certificates)

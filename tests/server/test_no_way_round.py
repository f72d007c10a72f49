"""No way round a policy on a server: a walk by chance that an oracle judges, and cases by name.

The oracle (`policy_oracle`) is written from docs/security.md alone. The record is the device's own: what it
holds, and which reads and writes its hooks saw.
"""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from random import Random

import pytest
from plain_device import SIZE, PlainDevice
from policy_chance import HOSTS, Chance, policy_of
from policy_clients import connected
from policy_oracle import COIL, HOLDING, Asker, ModelPolicy, Verdict, asked, judge
from policy_walk import Judge, Tally, Walk

import busway
from busway.codes import Table
from busway.observe.metrics.observer import MetricsObserver
from busway.server.hooks import Access
from busway.testing.certificates import CertificateFiles, CertificateStore

SEEDS = range(15)
SOAK_SEEDS = range(1000, 1200)
STEPS = 300
SCHEMES = ("tcp://", "udp://", "rtu+tcp://", "tls://")


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> dict[str | None, CertificateFiles]:
    store = CertificateStore(tmp_path_factory.mktemp("certificates"))
    made: dict[str | None, CertificateFiles] = {role: store.client(role, role=role) for role in ("operator", "viewer")}
    return made | {None: store.server()}


def served(plain: PlainDevice) -> busway.Device:
    """The same device for the library."""
    return busway.Device(
        holding_registers=plain.holding,
        input_registers=plain.input,
        coils=plain.coil,
        discrete_inputs=plain.discrete,
        files=plain.files,
        fifos={5: plain.queue},
    )


def watch(device: busway.Device, seen: list[tuple[str, int, int]]) -> None:
    """Let a device note what it is asked for; where it has hooks, requests take the generic path."""

    def note(access: Access) -> None:
        seen.append((COIL if access.table is Table.COILS else HOLDING, access.address, access.count))

    device.on_read(Table.HOLDING_REGISTERS, note)
    device.on_write(Table.HOLDING_REGISTERS, note)
    device.on_write(Table.COILS, note)


class ServerWorld:
    """A server with devices of this process, and plain devices as the model of them."""

    def __init__(
        self,
        server: busway.Server,
        devices: Mapping[int, busway.Device],
        plain: Mapping[int, PlainDevice],
        audit: Path | None,
        asked_of_devices: list[tuple[str, int, int]],
    ):
        self._server = server
        self._devices = devices
        self.devices = plain
        self.line_units = frozenset(plain)
        self.audit = audit
        self._asked = asked_of_devices
        self._may: set[tuple[str, int, int]] = set()
        self.endpoints: Sequence[str] = server.endpoints

    def known_units(self, unit: int) -> frozenset[int]:
        """A sole device answers to 0 and 255 too."""
        if unit in (0, 255) and len(set(map(id, self.devices.values()))) == 1:
            return frozenset({unit, *self.devices})
        mine = self.devices.get(unit)
        return frozenset({unit, *(one for one, device in self.devices.items() if device is mine)})

    def _plain(self, unit: int) -> PlainDevice | None:
        return next((self.devices[one] for one in self.known_units(unit) if one in self.devices), None)

    def judge(self, policy: ModelPolicy, asker: Asker, unit: int, pdu: bytes) -> Verdict:
        """For the device that is asked."""
        plain = self._plain(unit)
        registers = {} if plain is None else dict(enumerate(plain.holding))
        return judge(policy, asker, self.known_units(unit), pdu, registers)

    def held(self, unit: int, space: str) -> list[int] | None:
        """Of the device that is asked."""
        plain = self._plain(unit)
        return None if plain is None else list(getattr(plain, space))

    def permitted(self, unit: int, pdu: bytes) -> bytes | None:
        """As the model answers."""
        plain = self._plain(unit)
        self._may |= {(one.space, one.first, one.last - one.first + 1) for one in asked(pdu).touched}
        return bytes((pdu[0] | 0x80, 0x0B)) if plain is None else plain.execute(pdu)

    def refused(self, unit: int, pdu: bytes) -> None:
        """What is refused changes nothing, but it may have been asked."""
        self._may |= {(one.space, one.first, one.last - one.first + 1) for one in asked(pdu).touched}

    def replace(self, policy: ModelPolicy) -> None:
        """At once."""
        self._server.replace_policy(policy_of(policy))

    def check(self, about: object) -> None:
        """Every item that can be written, and what the hooks of the devices saw."""
        assert set(self._asked) <= self._may, f"{set(self._asked) - self._may}: {about}"
        self._asked.clear()
        self._may.clear()
        for unit, plain in self.devices.items():
            device = self._devices[unit]
            held = struct.pack(f">{SIZE}H", *plain.holding)
            assert device.peek(Table.HOLDING_REGISTERS, 0, SIZE) == held, str(about)
            bits = sum(bool(bit) << n for n, bit in enumerate(plain.coil)).to_bytes(SIZE // 8, "little")
            assert device.peek(Table.COILS, 0, SIZE) == bits, str(about)
            for number, records in plain.files.items():
                assert device.peek_file(number, 0, SIZE) == struct.pack(f">{SIZE}H", *records), str(about)

    def hold(self) -> None:
        """Devices of the process answer at once."""

    def release(self) -> None:
        """Likewise."""


async def walk(seed: int, steps: int, tmp_path: Path, certificates: Mapping[str | None, CertificateFiles]) -> Tally:
    """One walk over a server that is put together by chance."""
    random = Random(seed)
    one, other = PlainDevice(), PlainDevice()
    plain = random.choice(({1: one}, {1: one, 2: one, 3: other}, {1: one, 3: other}))
    made = {id(device): served(device) for device in plain.values()}
    devices = {unit: made[id(device)] for unit, device in plain.items()}
    urls = ["tcp://127.0.0.1:0", "udp://127.0.0.1:0", "rtu+tcp://127.0.0.1:0"]
    if random.random() < 0.3:
        urls.append(f"tls://127.0.0.1:0?{certificates[None].query()}")
    path = tmp_path / f"{seed}.jsonl"
    audit = None if random.random() < 0.3 else busway.AuditLog(path, interval=0, repeat_interval=0)
    seen: list[tuple[str, int, int]] = []
    if random.random() < 0.25:
        for device in made.values():
            watch(device, seen)
    chance = Chance(seed, SCHEMES, (1, 1, 1, 2, 3, 0, 255, 9))
    policy = chance.policy()
    server = busway.serve(*urls, units=devices, policy=policy_of(policy), audit=audit)
    if random.random() < 0.5:
        server.observe(MetricsObserver())
    async with server, connected(server.endpoints, HOSTS, certificates) as clients:
        world = ServerWorld(server, devices, plain, None if audit is None else path, seen)
        judge = Judge(world, policy, seed)
        try:
            tally = await Walk(world, clients, chance, judge, one_unit_together=False).go(steps)
        finally:
            judge.close()
            if audit is not None:
                audit.close()
    return tally


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

"""Ways round the rule of a point, one by one: each was open once."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from ruled_plant import HandedInput, RuledPlant
from waiting import set_forward, until

from busway.apps.collector.commands.claims import KeysUnavailable
from busway.apps.collector.commands.command import CommandResult, CommandState, PointCommand
from busway.apps.collector.commands.command_messages import CommandMessageHandler, InputMessage, InputRights
from busway.apps.collector.commands.rights import WriterRights
from busway.codes import Table
from busway.errors import InvalidRequest
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister
from busway.points import Point, WriteRule
from busway.values import value_type

HOLDING = Table.HOLDING_REGISTERS
SETPOINT = Point("setpoint", HOLDING, 0, value_type("uint16"), writing=WriteRule(6))
BREAKER = Point("breaker", HOLDING, 1, value_type("uint16"), writing=WriteRule(6, role="configure", armed=True))
DOOR = Point("door", HOLDING, 2, value_type("bit:3"), writing=WriteRule(6, verify="read-back"))
SHOWN = Point("shown", HOLDING, 3, value_type("uint16"), writing=WriteRule(6, verify="read-back"))
OLGA, CARL = "olga-0123456789-olga", "carl-0123456789-carl"


@asynccontextmanager
async def commanded(folder: Path) -> AsyncIterator[RuledPlant]:
    plant = RuledPlant(
        folder, [SETPOINT, BREAKER, DOOR, SHOWN], {OLGA: ("olga", "operate"), CARL: ("carl", "configure")}
    )
    await plant.start()
    plant.add_input("broker", "mqtt", ["boiler/*"], "configure")
    plant.add_input("carl", "mqtt", ["boiler/*"], "configure")
    try:
        yield plant
    finally:
        await plant.stop()


def body(point: str, value: Any, **more: Any) -> dict[str, Any]:
    return {"device": "boiler", "point": point, "value": value, **more}


async def armed(plant: RuledPlant, **more: Any) -> str:
    answer = await plant.message("broker", "breaker", json.dumps({"value": 7, "arm": True, **more}).encode())
    key: str = answer["key"]
    return key


async def confirmed(plant: RuledPlant, content: dict[str, Any], *, point: str = "breaker", **more: Any) -> Any:
    return await plant.message("broker", point, json.dumps(content).encode(), **more)


# What holds when a command is sent is what counts.


@pytest.mark.parametrize("rule", [WriteRule(6, role="configure"), WriteRule(6, armed=True)])
async def test_a_command_that_waited_while_its_point_came_to_need_more_is_not_sent(
    tmp_path: Path, rule: WriteRule
) -> None:
    async with commanded(tmp_path) as plant:
        plant.claims.released.clear()
        waiting = asyncio.create_task(plant.page(OLGA, "", body("setpoint", 7, expires=plant.now + 30)))
        await until(lambda: plant.claims.waiting)
        await plant.reload([replace(SETPOINT, writing=rule)])
        plant.claims.released.set()
        _, answer = await waiting
        assert (answer["state"], plant.device.writes) == ("failed", [])
        assert answer["reason"].endswith("nothing was sent")


async def test_a_confirmed_command_that_waited_while_its_link_was_begun_anew_is_not_sent(tmp_path: Path) -> None:
    async with commanded(tmp_path) as plant:
        _, armed = await plant.page(CARL, "/arm", body("breaker", 7))
        plant.claims.released.clear()
        waiting = asyncio.create_task(plant.page(CARL, f"/{armed['key']}/confirm"))
        await until(lambda: plant.claims.waiting)
        await plant.reload([replace(BREAKER, start=5)])
        plant.claims.released.set()
        _, answer = await waiting
        assert (answer["state"], plant.device.writes) == ("failed", [])
        assert "begun anew since this was armed" in answer["reason"]


async def test_a_link_that_is_begun_anew_just_then_uses_up_no_key(tmp_path: Path) -> None:
    async with commanded(tmp_path) as plant:
        write = plant.commands.write("boiler", "setpoint", 7, by="plan", origin="program", key="k")
        waiting = asyncio.create_task(write)
        await asyncio.sleep(0)  # it was looked up, and its task has not begun
        plant.poller.finish()
        assert (await waiting).state is CommandState.REFUSED
        await plant.reload([SETPOINT])
        again = await plant.commands.write("boiler", "setpoint", 7, by="plan", origin="program", key="k")
        assert (again.state, plant.device.writes) == (CommandState.DONE, [(0, 7)])


async def test_the_time_of_a_command_that_waits_for_another_with_its_key_becomes_no_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with commanded(tmp_path) as plant:
        claim, released, tries = plant.claims.claim, asyncio.Event(), []

        async def claim_later(result: CommandResult) -> CommandResult | None:
            tries.append(result)
            if len(tries) == 1:
                await released.wait()
                raise KeysUnavailable("no answer")
            return await claim(result)

        monkeypatch.setattr(plant.claims, "claim", claim_later)

        def write(value: int) -> "asyncio.Task[CommandResult]":
            made = plant.commands.write("boiler", "setpoint", value, by="plan", origin="program", key="k")
            return asyncio.create_task(made)

        first = write(7)
        await until(lambda: tries)
        second = write(8)
        await asyncio.sleep(0)
        plant.now -= 3600
        set_forward(monkeypatch, 31.0)
        released.set()
        assert ((await first).state, (await second).state) == (CommandState.REFUSED, CommandState.EXPIRED)
        assert plant.device.writes == []


# Who confirms.


async def test_a_role_that_was_taken_away_since_a_command_was_armed_is_missing(tmp_path: Path) -> None:
    async with commanded(tmp_path) as plant:
        _, armed = await plant.page(CARL, "/arm", body("breaker", 7))
        plant.tokens[CARL] = ("carl", "operate")
        _, answer = await plant.page(CARL, f"/{armed['key']}/confirm")
        assert (answer["state"], plant.device.writes) == ("refused", [])
        assert "needs the role configure, and the writer has operate" in answer["reason"]


async def test_messages_of_a_sink_whose_role_was_taken_away_confirm_nothing(tmp_path: Path) -> None:
    async with commanded(tmp_path) as plant:
        key = await armed(plant)
        plant.add_input("broker", "mqtt", ["boiler/*"], "operate")
        answer = await confirmed(plant, {"confirm": key})
        assert (answer["state"], plant.device.writes) == ("refused", [])
        assert "needs the role configure" in answer["reason"]


async def test_a_sink_with_the_name_of_a_person_confirms_nothing_of_that_person(tmp_path: Path) -> None:
    async with commanded(tmp_path) as plant:
        _, armed = await plant.page(CARL, "/arm", body("breaker", 7))
        answer = await plant.message("carl", "breaker", json.dumps({"confirm": armed["key"]}).encode())
        assert (answer["state"], plant.device.writes) == ("refused", [])
        assert answer["reason"] == "it was armed by way of page, and has to be confirmed on that way"
        _, done = await plant.page(CARL, f"/{armed['key']}/confirm")
        assert (done["state"], plant.device.writes) == ("done", [(1, 7)])


async def test_two_senders_whose_names_begin_alike_are_two(tmp_path: Path) -> None:
    async with commanded(tmp_path) as plant:
        answer = await confirmed(plant, {"value": 7, "arm": True, "by": "x" * 101})
        assert (answer["state"], "at most 100 characters" in answer["reason"]) == ("refused", True)
        key = await armed(plant, by="x" * 100)
        assert (await confirmed(plant, {"confirm": key, "by": "x" * 101}))["state"] == "refused"
        assert plant.device.writes == []
        assert (await confirmed(plant, {"confirm": key, "by": "x" * 100}))["state"] == "done"


# Messages.


@pytest.mark.parametrize(("waited", "left"), [(10.0, None), (11.0, None), (2.0, 2.0), (0.0, 0.0)])
async def test_a_message_in_two_steps_that_came_too_late_does_nothing(
    tmp_path: Path, waited: float, left: float | None
) -> None:
    async with commanded(tmp_path) as plant:
        late: dict[str, Any] = {"arrived": plant.moment - waited, "seconds_left": left}
        answer = await confirmed(plant, {"value": 7, "arm": True}, **late)
        assert (answer["state"], answer["reason"]) == ("refused", "its time was over; nothing is armed")
        answer = await confirmed(plant, {"confirm": await armed(plant)}, **late)
        assert (answer["state"], plant.device.writes) == ("expired", [])


@pytest.mark.parametrize("key", [[], {}, ["k"], None, 5, True, "", "\ud800", "k" * 101, "busway-0"])
async def test_what_can_be_no_key_confirms_nothing_and_is_answered(tmp_path: Path, key: Any) -> None:
    async with commanded(tmp_path) as plant:
        answer = await confirmed(plant, {"confirm": key})
        assert (answer["state"], answer["reason"]) == ("refused", "there is no command with this key; arm it anew")


async def test_a_confirmation_says_nothing_of_another_point(tmp_path: Path) -> None:
    async with commanded(tmp_path) as plant:
        key = await armed(plant)
        assert (await confirmed(plant, {"confirm": key}))["state"] == "done"
        answer = await confirmed(plant, {"confirm": key}, point="setpoint")
        assert (answer["state"], answer["reason"]) == ("refused", "it was armed for boiler/breaker; nothing was sent")


async def test_a_message_that_is_passed_on_in_a_fleet_keeps_its_role(tmp_path: Path) -> None:
    """The owner of the link may have a newer file, in which the point needs a higher role."""
    passed: list[tuple[PointCommand, str]] = []

    class Owners:
        group, member = "hall", "c0"

        def owned_since(self, device: str) -> None:
            return None

        async def answers(self, device: str | None) -> bool:
            return True

        async def pass_on(self, command: PointCommand, role: str) -> dict[str, Any]:
            passed.append((command, role))
            return {}

    rights = InputRights("plant/{device}/{point}", ("*/*",), 10.0, "operate")
    async with commanded(tmp_path) as plant:
        receiver = CommandMessageHandler(
            "broker", HandedInput("mqtt", rights), plant.commands, lambda: plant.configuration, others=Owners()
        )
        await receiver.handle(InputMessage("plant/boiler/setpoint", b"7"))
        assert [role for _, role in passed] == ["operate"]
        await plant.reload([replace(SETPOINT, writing=WriteRule(6, role="configure"))])
        answer = await plant.fleet(body("setpoint", 7, key="a", role="operate"))
        assert (answer["state"], "needs the role configure" in answer["reason"]) == ("refused", True)
        assert (await plant.fleet(body("setpoint", 7, key="b", role="admin")))["state"] == "refused"
        assert (await plant.fleet(body("setpoint", 7, key="c")))["state"] == "done"
        assert plant.device.writes == [(0, 7)]


# Maintenance.


async def test_a_write_is_not_sent_if_maintenance_begins_while_its_register_is_read(tmp_path: Path) -> None:
    async with commanded(tmp_path) as plant:
        await until(lambda: plant.poller.schedule.devices["boiler"].lives)

        def begin(request: Any) -> None:
            if isinstance(request, ReadHoldingRegisters) and request.address == DOOR.start:
                plant.maintain(True)

        plant.device.before_answer = begin
        result = await plant.commands.write("boiler", "door", True, by="plan", origin="program")
        assert (result.state, result.reason) == (CommandState.FAILED, "boiler is in maintenance; nothing was sent")
        assert plant.device.writes == []


async def test_a_device_is_not_read_back_once_its_maintenance_has_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busway.apps.collector.commands.runner.SHOWN_AFTER", (0.0, 0.0))
    async with commanded(tmp_path) as plant:
        await until(lambda: plant.poller.schedule.devices["boiler"].lives)
        reads: list[int] = []

        def note(request: Any) -> None:
            if isinstance(request, WriteSingleRegister):
                plant.maintain(True)
            else:
                reads.append(request.address)

        plant.device.before_answer = note
        result = await plant.commands.write("boiler", "shown", 7, by="plan", origin="program")
        assert SHOWN.start not in reads
        assert result.state is CommandState.UNKNOWN
        assert result.reason.endswith("could not be read back: boiler is in maintenance")


# Programs.


async def test_a_program_may_confirm_with_less_than_it_has(tmp_path: Path) -> None:
    async with commanded(tmp_path) as plant:
        made = plant.commands.arm("boiler", "breaker", 7, by="plan", origin="program")
        result = await plant.commands.confirm(made.command.key, by="plan", rights=WriterRights("operate"))
        assert (result.state, plant.device.writes) == (CommandState.REFUSED, [])
        made = plant.commands.arm("boiler", "breaker", 7, by="plan", origin="program")
        with pytest.raises(InvalidRequest, match="plan has armed it"):
            await plant.commands.confirm(made.command.key, by="Plan")

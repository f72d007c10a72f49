"""A configuration that is read again: all of it is applied, or nothing."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

import busway
from busway.apps.service.configuration import Configuration, parse_configuration
from busway.apps.service.overrides import Overrides
from busway.apps.service.service import Service
from busway.server.listener import Listener

CONFIGURATION = 'listen = ["tcp://127.0.0.1:0"]\n[policy]\ndefault = "{}"\n[[unit]]\nunit = 1\nholding_registers = 10\n'


async def test_nothing_is_applied_where_the_audit_log_cannot_be_opened_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    applied: list[Configuration] = []

    async def apply_to(
        new: Configuration,
        running: object,
        listen: Sequence[Listener],
        *,
        policy: busway.Policy | None,
        at_once: Callable[[Sequence[str]], None],
    ) -> list[str]:
        applied.append(new)
        at_once(["a route of the test"])
        return ["a route of the test"]

    monkeypatch.setattr(Configuration, "apply_to", apply_to)
    path, default = tmp_path / "audit.jsonl", ["allow"]
    overrides = Overrides(audit=str(path), control="off", can_reload=True)
    async with (
        Service(lambda: parse_configuration(CONFIGURATION.format(default[0]), "x.toml"), overrides) as service,
        busway.open(service.server.endpoints[0], shared=False) as link,
    ):
        default[0] = "read-only"
        path.unlink()
        path.mkdir()
        with pytest.raises(busway.ConfigError, match=r"audit\.jsonl"):
            await service.reload()
        assert not applied
        await link.unit(1).write_single_register(0, 1)
        path.rmdir()
        assert await service.reload() == [
            "the audit log was opened anew",
            "a route of the test",
            "the policy was replaced",
        ]
        assert len(applied) == 1
        with pytest.raises(busway.ExceptionReply, match="exception 01"):
            await link.unit(1).write_single_register(0, 1)

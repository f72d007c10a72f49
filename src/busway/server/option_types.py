"""The options of `busway.serve`, for type checkers.

Written by ``scripts/option_types.py`` from `busway.options`, where each option is declared.
"""

from typing import Literal, TypedDict

from ..options.networks import Networks
from ..options.presets import Preset
from ..options.server import Scope, UnitPolicy, UnlistedUnit


class ServerOptions(TypedDict, total=False):
    """What `busway.serve` takes by name beside its own arguments."""

    standard_port: bool | None
    unit_policy: UnitPolicy | Literal["listed", "any"]
    unlisted: UnlistedUnit | Literal["exception", "silence"]
    max_transactions: int
    scope: Scope | Literal["connection", "server"]
    diagnostics_changes: bool | None
    backlog: int
    priority: Networks | list[str] | tuple[str, ...] | str
    max_priority_connections: int
    max_priority_per_host: int | None
    max_connections: int
    max_per_host: int | None
    shared_slots: bool
    write_buffer: int
    write_timeout: float | None
    single_adu_segments: bool
    header_timeout: float | None
    frame_timeout: float | None
    idle_timeout: float | None
    request_rate: float | None
    answer_half_closed: bool
    interface: str | None
    connect_timeout: float
    keepalive: bool
    keepalive_idle: int
    keepalive_interval: int
    keepalive_count: int
    user_timeout: float | None
    no_delay: bool
    receive_buffer: int | None
    send_buffer: int | None
    local_address: str | None
    preset: Preset | Literal["standard", "strict", "passive"]

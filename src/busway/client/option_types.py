"""The options of `busway.connect` and `busway.open`, for type checkers.

Written by ``scripts/option_types.py`` from `busway.options`, where each option is declared.
"""

from typing import Literal, TypedDict

from ..framing.character_times import Parity
from ..framing.echo import Echo
from ..options.client import Hold, MismatchPolicy, TransactionScope
from ..options.ports import Rs485
from ..options.presets import Preset
from ..options.tls import Curve, TlsVersion, Verify


class LinkOptions(TypedDict, total=False):
    """Keyword options of `busway.connect` and `busway.open`; the scheme decides which are accepted."""

    timeout: float
    retries: int
    write_retries: int
    deadline: float | None
    max_transactions: int
    scope: TransactionScope | Literal["connection", "client"]
    queue: int
    transaction_policy: MismatchPolicy | Literal["strict", "automatic", "ignore"]
    unit_policy: MismatchPolicy | Literal["strict", "automatic", "ignore"]
    recycle_after_timeouts: int
    recycle_after_foreign: int
    single_adu_segments: bool
    connect_delay: float
    request_gap: float
    register_width: int
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
    hold: float | Hold | Literal["forever", "request"]
    reconnect_first: float
    reconnect_most: float
    max_connections: int
    interface: str | None
    certificate: str | None
    key: str | None
    password_file: str | None
    authority: str | None
    minimum_version: TlsVersion | Literal["1.2", "1.3"]
    maximum_version: TlsVersion | Literal["1.2", "1.3"]
    ciphers: str | None
    curve: Curve | Literal["P-256", "any"]
    revocation_list: str | None
    handshake_timeout: float
    server_name: str | None
    verify: Verify | Literal["always", "off-insecure"]
    turnaround_delay: float
    unit_switch_gap: float
    quiet_window: float
    drain_limit: float
    trust_reply_order: bool
    early_replies: bool
    open_after: int
    first_pause: float
    longest_pause: float
    probe_timeout: float
    strict_timing: bool
    gap_limit: float | None
    character_timeout: float
    delimiter: int
    upper_case_only: bool
    baud: int
    parity: Parity | Literal["even", "odd", "none", "E", "O", "N"]
    data_bits: int
    stop_bits: int | None
    rs485: Rs485 | Literal["off", "kernel", "rts", "automatic"]
    rts_on_send: bool
    rts_after_send: bool
    delay_before_send: float
    delay_after_send: float
    echo: Echo | Literal["off", "on", "automatic"]
    low_latency: bool
    exclusive: bool
    mark_errors: bool
    port_wait: float
    reopen_first: float
    reopen_most: float
    precise_timing: bool
    baudrate: int
    bytesize: int
    stopbits: int | None
    preset: Preset | Literal["standard", "strict", "passive"]

"""Direction control of an RS-485 adapter: by the port's driver, or by the RTS signal.

Knows the kernel's structure (``struct serial_rs485`` of ``linux/serial.h``) and the modem lines; knows no timing:
delays around a switch of RTS are kept by the caller.
"""

import math
import struct
from enum import Enum

from ...errors import ConfigError
from ...options.ports import Echo, Rs485, SerialSettings
from .ioctl import Ioctl, asked, asked_integer, system_ioctl

TIOCGRS485 = 0x542E
TIOCSRS485 = 0x542F
TIOCMBIS = 0x5416
TIOCMBIC = 0x5417
TIOCM_RTS = 0x004

ENABLED = 1 << 0
RTS_ON_SEND = 1 << 1
RTS_AFTER_SEND = 1 << 2
RECEIVE_WHILE_SENDING = 1 << 4

_LAYOUT = struct.Struct("III20x")
"""Layout of ``struct serial_rs485``: flags, delays before and after sending in milliseconds, and reserved bytes."""


class DriverDirection(Enum):
    """How an open RS-485 port is switched between sending and receiving.

    NONE: nothing has to be switched. KERNEL: the port's driver does it. RTS: this program does it by the RTS signal.
    """

    NONE = "none"
    KERNEL = "kernel"
    RTS = "rts"


def settle_direction(descriptor: int, settings: SerialSettings, ioctl: Ioctl = system_ioctl) -> DriverDirection:
    """Set up, by its settings, how an open RS-485 port is switched between sending and receiving; return how that is.

    With ``rs485=automatic`` its driver does it if it can, otherwise this program by RTS; RTS is then set to receiving.

    Raises:
        ConfigError: the settings ask for the kernel's RS-485 mode, and this port does not have it; or its driver does
            not offer the delays or RTS levels of the settings.
        OSError: the port is gone.
    """
    if settings.rs485 is Rs485.OFF:
        return DriverDirection.NONE
    if settings.rs485 is not Rs485.RTS and _kernel_mode(descriptor, settings, ioctl):
        return DriverDirection.KERNEL
    if settings.rs485 is Rs485.KERNEL:
        raise ConfigError("the driver of this port has no RS-485 mode; rs485=rts switches by the RTS wire", key="rs485")
    set_rts(descriptor, settings.rts_after_send, ioctl)
    return DriverDirection.RTS


def _kernel_mode(descriptor: int, settings: SerialSettings, ioctl: Ioctl) -> bool:
    flags = ENABLED
    if settings.rts_on_send:
        flags |= RTS_ON_SEND
    if settings.rts_after_send:
        flags |= RTS_AFTER_SEND
    if settings.echo is Echo.ON:
        flags |= RECEIVE_WHILE_SENDING
    # Whole milliseconds are all it takes; a shorter delay than asked for could cut off a character.
    before = math.ceil(settings.delay_before_send * 1000)
    after = math.ceil(settings.delay_after_send * 1000)
    if not asked(ioctl, descriptor, TIOCSRS485, bytearray(_LAYOUT.pack(flags, before, after))):
        return False
    # Drivers change what they cannot do and report success; only what they give back counts.
    taken = bytearray(_LAYOUT.size)
    if not asked(ioctl, descriptor, TIOCGRS485, taken):
        return True
    flags_taken, before_taken, after_taken = _LAYOUT.unpack(taken)
    if not flags_taken & ENABLED:
        return False
    for name, wanted, got in (
        ("delay_before_send", before, before_taken),
        ("delay_after_send", after, after_taken),
    ):
        if got < wanted:
            raise ConfigError(f"the driver of this port takes {got / 1000:g} seconds at most", key=name)
    levels = RTS_ON_SEND | RTS_AFTER_SEND
    if (flags_taken ^ flags) & levels:
        raise ConfigError("the driver of this port does not offer these levels of RTS", key="rts_on_send")
    return True


def set_rts(descriptor: int, level: bool, ioctl: Ioctl = system_ioctl) -> bool:
    """Raise or lower the port's RTS signal. Returns False if the port has none (a pseudo-terminal)."""
    return asked_integer(ioctl, descriptor, TIOCMBIS if level else TIOCMBIC, TIOCM_RTS) is not None

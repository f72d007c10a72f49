"""All ioctl calls to the driver of an open serial port, in one place so that a test can replace the driver.

Knows how to make the calls, and not what they are for. Results are written into the buffer
passed in; only `asked_integer` returns its result.
"""

import errno
import struct
from collections.abc import Callable

Ioctl = Callable[[int, int, bytearray], None]
"""Function that makes an ioctl call: its arguments are file descriptor, request number and buffer, into which the
driver writes its result. It raises `OSError` if the driver refuses.
"""

NOT_OFFERED = frozenset({errno.ENOTTY, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.EPERM, errno.EACCES})
"""Error numbers of a driver that lacks a feature, or denies it to this user."""


def system_ioctl(descriptor: int, request: int, buffer: bytearray) -> None:
    """Make an ioctl call to the operating system, which may change ``buffer``."""
    import fcntl  # where ports have no descriptors there is no such module, and this is not reached

    fcntl.ioctl(descriptor, request, buffer)


def asked(ioctl: Ioctl, descriptor: int, request: int, buffer: bytearray) -> bool:
    """Make an ioctl call by the function ``ioctl``. Returns False if the driver lacks it or denies it to this user.

    The result of a call that succeeded is in ``buffer``. Other errors are raised as `OSError`.
    """
    try:
        ioctl(descriptor, request, buffer)
    except OSError as error:
        if error.errno in NOT_OFFERED:
            return False
        raise
    return True


def asked_integer(ioctl: Ioctl, descriptor: int, request: int, value: int = 0) -> int | None:
    """Make an ioctl call with an integer and return its integer result; None if the driver does not offer it.

    Other errors are raised as `OSError`.
    """
    buffer = bytearray(struct.pack("i", value))
    if not asked(ioctl, descriptor, request, buffer):
        return None
    return int(struct.unpack("i", buffer)[0])

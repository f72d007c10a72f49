"""The key under which the decision about a request is cached: requests with equal keys are decided alike.

Knows the fields of requests that say what they touch; knows no rule.

1. A key holds all that a policy looks at: the function, the unit asked, the unit under which its device is configured,
   and the items. The client is not in it: decisions are cached for each set of rights.
2. Values are in no key. Where rules have limits, register writes have no key and are decided each time.
"""

from collections.abc import Callable
from typing import Any, Final

from ..pdu.functions import AnyRequest
from ..pdu.read_items import ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters
from ..pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)


def _one(request: Any) -> tuple[int, ...]:  # any request with these fields, as in the others
    return (request.address,)


def _range(request: Any) -> tuple[int, ...]:
    return request.address, request.count


def _two_ranges(request: Any) -> tuple[int, ...]:
    return request.read_address, request.read_count, request.write_address, request.write_count


_ITEMS: Final[dict[type, tuple[Callable[[Any], tuple[int, ...]], bool]]] = {
    ReadCoils: (_range, False),
    ReadDiscreteInputs: (_range, False),
    ReadHoldingRegisters: (_range, False),
    ReadInputRegisters: (_range, False),
    WriteSingleCoil: (_one, False),
    WriteMultipleCoils: (_range, False),
    WriteSingleRegister: (_one, True),
    WriteMultipleRegisters: (_range, True),
    MaskWriteRegister: (_one, True),
    ReadWriteMultipleRegisters: (_two_ranges, True),
}
"""The items of a request, and whether it writes registers, which may have limits."""


def decision_key(request: AnyRequest, unit: int, listed: int | None, *, limits: bool) -> object:
    """The cache key of a request to a unit; None if it must be decided each time.

    Args:
        request: the request.
        unit: the unit asked.
        listed: the unit as which its device is listed; None where nobody knows of such.
        limits: whether any rule has limits of what may be written.
    """
    known = _ITEMS.get(type(request))
    if known is None:
        return None
    items, writes_registers = known
    if writes_registers and limits:
        return None
    return (type(request), unit, listed, *items(request))

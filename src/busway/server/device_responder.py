"""The responder of a server with devices in its own process: finds the device of the unit and executes the request.

Knows devices and the rules of units on TCP; knows no connection.

1. Unit policy ``listed``: a request to a unit that is not listed is answered 0B (or not at all), because a client must
   learn that there is no such unit. Unit policy ``any``: the only device answers requests to any unit, as much hardware
   does.
2. Units 0 and 255 mean the device of a server that has exactly one device (Messaging on TCP/IP V1.0b §4.4.1.2). On a
   serial line they do not: there only listed units are answered, since other devices answer for theirs.
3. Function not offered → 01, before its lengths are judged (Application Protocol V1.1b3 figure 9).
4. A request is executed under the device's lock: functions 22 and 23 read and write in one step, for every thread.
5. A device that is listed as several units executes a broadcast of a serial line once.
"""

from collections.abc import Mapping

from ..codes import BROADCAST_UNIT, TCP_DEVICE_UNIT, ExceptionCode
from ..errors import ConfigError
from ..options.server import UnitPolicy, UnlistedUnit
from ..pdu.exception_response import ExceptionResponse
from ..pdu.file_records import WriteFileRecord
from ..pdu.functions import STANDARD, AnyRequest, FunctionTable
from ..pdu.malformed_request import MalformedRequest
from ..pdu.message import Request
from ..pdu.unknown_functions import OpaqueRequest
from ..session.responder import SILENCE, Replaced, RequestContext, ResponderAnswer, ServedUnit
from .device import Device


class DeviceResponder:
    """Responder that executes requests on the devices of this process.

    Args:
        units: device by unit identifier, 0…255.
        unit_policy: which units are answered, `UnitPolicy`; ``ANY`` needs exactly one device.
        unlisted: how a request to a unit that does not exist is answered: with 0B, or not at all.
        functions: the table of functions, with the user's own if there are any.

    Raises:
        ConfigError: no units, a wrong unit or device, or the unit policy ``ANY`` with several devices.

    Attributes:
        functions: the table of functions.
        generation: a number that changes when the hooks or the offered functions of a device change.
    """

    def __init__(
        self,
        units: Mapping[int, Device],
        *,
        unit_policy: UnitPolicy = UnitPolicy.LISTED,
        unlisted: UnlistedUnit = UnlistedUnit.EXCEPTION,
        functions: FunctionTable = STANDARD,
    ) -> None:
        if not isinstance(units, Mapping):
            raise ConfigError(f"must be a device, or devices by unit as in {{1: device}}, not {units!r}", key="units")
        for unit, device in units.items():
            if not isinstance(unit, int) or not 0 <= unit <= 255:
                raise ConfigError(f"a unit is 0…255, not {unit!r}", key="units")
            if not isinstance(device, Device):
                raise ConfigError(f"unit {unit} must be a busway.Device, not {device!r}", key="units")
        if not units:
            raise ConfigError("at least one unit is needed", key="units")
        distinct = {id(device): device for device in units.values()}
        if unit_policy is UnitPolicy.ANY and len(distinct) > 1:
            raise ConfigError("unit policy any needs exactly one device", key="unit_policy")
        self._devices: dict[int, Device] = dict(units)
        listed: dict[int, list[int]] = {}
        for unit, device in units.items():
            listed.setdefault(id(device), []).append(unit)
        self._served = {
            unit: ServedUnit(unit, device, units=frozenset(listed[id(device)])) for unit, device in units.items()
        }
        if len(distinct) == 1:
            first = next(iter(units))
            beside = range(256) if unit_policy is UnitPolicy.ANY else (BROADCAST_UNIT, TCP_DEVICE_UNIT)
            for unit in beside:
                self._devices.setdefault(unit, units[first])
                self._served.setdefault(unit, self._served[first])
        self._silent = unlisted is UnlistedUnit.SILENCE
        self.functions = functions
        # Counted when a device changes, not summed up at every receive call: a server may have 247 devices.
        self.generation: int = 0
        for device in distinct.values():
            device.watch(self._device_changed)

    def _device_changed(self) -> None:
        self.generation += 1

    def serves(self, unit: int) -> ServedUnit | None:
        """Return the unit that answers requests to ``unit``, 0…255: its device, and all units configured for that.

        None if no device answers for ``unit``. If a sole device answers besides, as for 0 and 255, it is the first unit
        configured for the device (`ServedUnit`).
        """
        return self._served.get(unit)

    def find(self, unit: int) -> Device | None:
        """Return the device that answers for ``unit``; None if there is none."""
        return self._devices.get(unit)

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        """Execute a request on the device of its unit, and return the reply.

        Exception replies: 0B for a unit that does not exist, 01 for a function that the device does not offer, and the
        code of a `MalformedRequest`. `SILENCE`, so that no reply is sent, for a unit that does not exist with
        ``UnlistedUnit.SILENCE``, and for a broadcast that the same device has executed already as another unit.

        Raises:
            Refusal: the device or a hook refuses the request; the caller answers with its exception code.
        """
        device = self._devices.get(context.unit)
        if device is None:
            absent = ExceptionResponse(context.function, ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND)
            return SILENCE if self._silent else absent
        if context.executed is not None:
            if id(device) in context.executed:
                context.judged = None  # another of its units has executed it: there is nothing to record
                return SILENCE
            context.executed.add(id(device))
        if isinstance(request, OpaqueRequest) or not device.enabled(context.function):
            return ExceptionResponse(context.function, ExceptionCode.ILLEGAL_FUNCTION)
        if isinstance(request, MalformedRequest):
            return ExceptionResponse(context.function, request.code)
        with device.lock:
            if context.judged is not None and context.judged.is_write:
                context.replacing(_replaced(device, request))
            return request.apply(device, context)


def _replaced(device: Device, request: Request) -> Replaced:
    """Return the values that a write will replace, as bytes for each range that it writes; None for an absent range.

    The caller holds the device's lock.
    """
    if isinstance(request, WriteFileRecord):
        return tuple(device.peek_file(group.file, group.record, group.count) for group in request.groups)
    return tuple(device.peek(span.table, span.address, span.count) for span in request.spans() if span.writes)

"""The handler of a server that holds its devices itself: unit → device, then the function does its work on it.

Knows devices and the rules of units on TCP; knows no connection.

1. ``listed``: a unit that is not listed is answered 0B (or not at all), because a client must learn that nobody is
   there. ``any``: the sole device answers whatever unit it is asked with, as much hardware does.
2. 0 and 255 address the device of a server that has exactly one (Messaging on TCP/IP V1.0b §4.4.1.2). On a serial line
   they do not: only the units listed are its own there, since others answer for themselves.
3. Function not offered → 01, before its lengths are judged (Application Protocol V1.1b3 figure 9).
4. A request is executed under the device's lock: 22 and 23 read and write in one step, for every thread.
5. A device that is listed as several units executes a broadcast of a serial line once.
"""

from collections.abc import Callable, Mapping

from ..codes import BROADCAST_UNIT, LAST_SERIAL_UNIT, TCP_DEVICE_UNIT, ExceptionCode
from ..errors import ConfigError
from ..options.server import UnitPolicy, UnlistedUnit
from ..pdu.direct import Answer, DeviceAnswers, ReadPlan
from ..pdu.file_records import WriteFileRecord
from ..pdu.functions import STANDARD, AnyRequest, FunctionTable
from ..pdu.general import ExceptionResponse, MalformedRequest, OpaqueRequest
from ..pdu.message import Message, Request
from ..session.handler import SILENCE, Deferral, Outcome, RequestContext
from .device import Device


class LocalHandler:
    """Answers for devices of this process.

    Args:
        units: device by unit identifier, 0…255.
        unit_policy: `UnitPolicy`; ``ANY`` needs exactly one device.
        unlisted: what a unit gets that is not there.
        functions: the table of functions, with the user's own if there are any.
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
        self._units = dict(units)
        self._serial_units = frozenset(unit for unit in units if 1 <= unit <= LAST_SERIAL_UNIT)
        self._sole = next(iter(distinct.values())) if len(distinct) == 1 else None
        if unit_policy is UnitPolicy.ANY and self._sole is None:
            raise ConfigError("unit policy any needs exactly one device", key="unit_policy")
        self._any = unit_policy is UnitPolicy.ANY
        self._silent = unlisted is UnlistedUnit.SILENCE
        self.functions = functions
        # Counted when a device changes, not summed up at every receive call: a handler may have 247 devices.
        self.generation: int = 0
        self._answers: dict[int, Mapping[int, Answer]] = {}
        self._plans: dict[bytes, ReadPlan] = {}
        for device in distinct.values():
            device.watch(self._device_changed)

    def _device_changed(self) -> None:
        self._answers.clear()
        self._plans = {}
        self.generation += 1

    @property
    def serial_units(self) -> frozenset[int]:
        """The units that are answered on a serial line: those listed, whatever the policy (Serial Line V1.02 §2.2)."""
        return self._serial_units

    def find(self, unit: int) -> Device | None:
        """The device that answers for ``unit``."""
        device = self._units.get(unit)
        if device is None and self._sole is not None and (self._any or unit in (BROADCAST_UNIT, TCP_DEVICE_UNIT)):
            return self._sole
        return device

    def listed_unit(self, unit: int) -> int:
        """The unit as which the device is listed that answers for ``unit``, the first of several."""
        if unit in self._units or self.find(unit) is None:
            return unit
        return next(iter(self._units))

    def direct(self, context: RequestContext) -> Mapping[int, Answer]:
        """The compiled answers of the unit's device, by function code; the same for every connection."""
        answers = self._answers.get(context.unit)
        if answers is None:
            answers = self._answers[context.unit] = self._compiled(self.find(context.unit))
        return answers

    def plans(self, context: RequestContext) -> dict[bytes, ReadPlan]:
        """Plans of reads, the same for every connection."""
        return self._plans

    def plan(self, context: RequestContext, pdu: bytes) -> ReadPlan | None:
        """The plan of a read of registers, if nothing needs to know of it."""
        device = self.find(context.unit)
        function = self.functions.find(pdu, 0, len(pdu))
        if device is None or function is None or not device.enabled(pdu[0]):
            return None
        return function.plan(device, context.unit, pdu)

    def _compiled(self, device: Device | None) -> dict[int, Answer]:
        if device is None:
            return {}
        offered = [function for function in self.functions if device.enabled(function.code)]
        found = {function.code: function.direct(device) for function in offered if function.sub_code is None}
        return DeviceAnswers(device, {code: answer for code, answer in found.items() if answer is not None})

    def handle(self, context: RequestContext, request: AnyRequest) -> Outcome:
        """Execute a request on the unit's device."""
        device = self._executing(context, request)
        if not isinstance(device, Device):
            return device
        assert isinstance(request, Request)
        with device.lock:
            return request.apply(device, context)

    def observe_write(
        self, context: RequestContext, request: Request, see: Callable[[tuple[bytes | None, ...]], None]
    ) -> Outcome:
        """As `WriteObserver.observe_write`: the look and the execution happen under one hold of the device's lock."""
        device = self._executing(context, request)
        if not isinstance(device, Device):
            return device
        with device.lock:
            see(_replaced(device, request))
            return request.apply(device, context)

    def _executing(self, context: RequestContext, request: AnyRequest) -> Device | Message | Deferral:
        """The device that is to execute a request; or the answer, or `SILENCE`, where none is."""
        device = self.find(context.unit)
        if device is None:
            if self._silent:
                return SILENCE
            return ExceptionResponse(context.function, ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND)
        if context.executed is not None:
            if id(device) in context.executed:
                return SILENCE
            context.executed.add(id(device))
        if isinstance(request, OpaqueRequest) or not device.enabled(context.function):
            return ExceptionResponse(context.function, ExceptionCode.ILLEGAL_FUNCTION)
        if isinstance(request, MalformedRequest):
            return ExceptionResponse(context.function, request.code)
        return device


def _replaced(device: Device, request: Request) -> tuple[bytes | None, ...]:
    """What a write would replace, range by range; the caller holds the device's lock."""
    if isinstance(request, WriteFileRecord):
        return tuple(device.peek_file(group.file, group.record, group.count) for group in request.groups)
    return tuple(device.peek(span.table, span.address, span.count) for span in request.spans() if span.writes)

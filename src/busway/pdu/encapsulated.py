"""Function 43, Encapsulated Interface Transport: device identification (14) and CANopen (13).

Application Protocol V1.1b3 §6.19–§6.21.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Self

from ..codes import PDU_LIMIT, ExceptionCode, FunctionCode, MeiType
from ..errors import InvalidRequest
from .compiler import as_integer
from .device_interface import Context, DataModel, Refusal
from .fields import repeated, rest, u8
from .message import NEED_MORE, UNKNOWN_LENGTH, Message, ReplyMessage, Request

BASIC, REGULAR, EXTENDED, INDIVIDUAL = 1, 2, 3, 4
_LAST_OBJECT_OF_LEVEL = {BASIC: 0x02, REGULAR: 0x7F, EXTENDED: 0xFF}
_INDIVIDUAL_TOO = 0x80

MAX_OBJECT_SIZE = PDU_LIMIT - 7 - 2
"""Most bytes of an identification object: a reply with only one object has no room for more."""

OBJECT_NAMES = {
    0x00: "VendorName",
    0x01: "ProductCode",
    0x02: "MajorMinorRevision",
    0x03: "VendorUrl",
    0x04: "ProductName",
    0x05: "ModelName",
    0x06: "UserApplicationName",
}


@dataclass(frozen=True, slots=True)
class IdentificationObject:
    """One identification object: its number 0x00…0xFF and its value of at most 244 bytes (what fits one reply).

    Raises:
        InvalidRequest: the number is out of range, or the value too long or no bytes.
    """

    number: int
    value: bytes

    def __post_init__(self) -> None:
        if not 0 <= as_integer("number", self.number) <= 0xFF:
            raise InvalidRequest(f"number must be 0…255, not {self.number}")
        if not isinstance(self.value, bytes) or len(self.value) > MAX_OBJECT_SIZE:
            raise InvalidRequest(f"value must be at most {MAX_OBJECT_SIZE} bytes, not {self.value!r}")

    def encode(self) -> bytes:
        """Return the identification object as bytes: number, length, value."""
        return bytes((self.number, len(self.value))) + self.value

    @classmethod
    def decode_from(cls, data: bytes, at: int) -> tuple[Self, int]:
        """Decode the identification object at offset ``at`` of ``data``; return the object and the offset after it.

        Raises:
            ValueError: the object is cut off.
            InvalidRequest: its value is too long.
        """
        if at + 2 > len(data) or at + 2 + data[at + 1] > len(data):
            raise ValueError("the object is cut off")
        end = at + 2 + data[at + 1]
        return cls(data[at], data[at + 2 : end]), end


class ReadDeviceIdentification(Request):
    """43/14 Read Device Identification: reads identification objects (MODBUS Application Protocol V1.1b3 §6.21).

    Attributes:
        level: 1 basic, 2 regular, 3 extended: all objects up to this level, from ``object_id`` on; 4: the one object
            ``object_id``.
        object_id: number of an object, 0x00…0xFF. With level 1…3, a number that the device does not have at this level
            means the first object.
    """

    code: ClassVar[FunctionCode] = FunctionCode.ENCAPSULATED_INTERFACE
    sub_code: ClassVar[MeiType] = MeiType.READ_DEVICE_IDENTIFICATION
    sub_width = 1
    level: int = u8(BASIC, INDIVIDUAL, default=BASIC)
    object_id: int = u8(default=0)

    class Reply(ReplyMessage):
        """The reply of function 43/14: identification objects, as many as fit one PDU.

        Attributes:
            level: the level of the request, 1…4.
            conformity: the highest level of the device, plus 0x80 if it answers requests for one object.
            more_follows: 0xFF if a further request from ``next_object`` on is needed, else 0.
            next_object: number of the next object; 0 if none follows.
            number_of_objects: number of ``objects``.
            objects: the objects, by ascending number.
        """

        level: int = u8(BASIC, INDIVIDUAL)
        conformity: int = u8()
        more_follows: int = u8(values=(0x00, 0xFF))
        next_object: int = u8()
        number_of_objects: int = u8()
        objects: tuple[IdentificationObject, ...] = repeated(IdentificationObject, 0, 123)

        def validate(self) -> str | None:
            if self.number_of_objects != len(self.objects):
                return f"{len(self.objects)} objects where {self.number_of_objects} are announced"
            return None

        @classmethod
        def wire_length(cls, data: bytes, at: int, end: int) -> int:
            if end < at + 7:
                return NEED_MORE
            position = at + 7
            for _ in range(data[at + 6]):
                if end < position + 2:
                    return NEED_MORE
                position += 2 + data[position + 1]
            return position - at

    room: ClassVar[int] = PDU_LIMIT - 7

    def reply_shape(self) -> tuple[int, bytes]:
        return UNKNOWN_LENGTH, bytes((self.code, MeiType.READ_DEVICE_IDENTIFICATION))

    def check_reply(self, reply: Any) -> str | None:
        if self.level == INDIVIDUAL and [one.number for one in reply.objects] != [self.object_id]:
            return f"object {self.object_id} was asked for alone"
        return None

    def apply(self, model: DataModel, context: Context) -> Message:
        objects = model.identification()
        highest = max(objects, default=0)
        own_level = EXTENDED if highest > 0x7F else REGULAR if highest > 0x02 else BASIC
        conformity = own_level | _INDIVIDUAL_TOO
        if self.level == INDIVIDUAL:
            if self.object_id not in objects:
                raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS, f"no identification object {self.object_id}")
            one = IdentificationObject(self.object_id, objects[self.object_id])
            return self.Reply(self.level, conformity, 0, 0, 1, (one,))
        # A code above the device's level is answered with what the device has (§6.21, "Read Device ID code").
        level = min(self.level, own_level)
        numbers = [number for number in sorted(objects) if number <= _LAST_OBJECT_OF_LEVEL[level]]
        start = self.object_id if self.object_id in numbers else 0
        numbers = [number for number in numbers if number >= start]
        chosen: list[IdentificationObject] = []
        used = 0
        for number in numbers:
            used += 2 + len(objects[number])
            if used > self.room:
                return self.Reply(self.level, conformity, 0xFF, number, len(chosen), tuple(chosen))
            chosen.append(IdentificationObject(number, objects[number]))
        return self.Reply(self.level, conformity, 0, 0, len(chosen), tuple(chosen))


class CanopenGeneralReference(Request):
    """43/13 CANopen General Reference: carries a CANopen request, which is not examined here (V1.1b3 §6.20).

    Attributes:
        data: the bytes after the MEI type, 0…251 of them.
    """

    code: ClassVar[FunctionCode] = FunctionCode.ENCAPSULATED_INTERFACE
    sub_code: ClassVar[MeiType] = MeiType.CANOPEN_GENERAL_REFERENCE
    sub_width = 1
    is_write = True
    data: bytes = rest(0, 251)

    class Reply(ReplyMessage):
        """The reply of function 43/13: ``data`` is the CANopen answer, 0…251 bytes after the MEI type."""

        data: bytes = rest(0, 251)

    def apply(self, model: DataModel, context: Context) -> Message:
        return self.Reply(model.canopen(self.data))

"""The exceptions of pymodbus, and which of them stands for which error of busway. Knows nothing of clients."""

from ...errors import LinkDown, ModbusError


class ModbusException(Exception):
    """Base of the exceptions of pymodbus.

    Attributes:
        string: the message, without the words that `str` puts before it.
    """

    def __init__(self, string: str = "") -> None:
        self.string: str = string
        super().__init__(string)

    def __str__(self) -> str:
        return f"Modbus Error: {self.string}"

    def isError(self) -> bool:
        """True: programs ask responses and exceptions alike."""
        return True


class ModbusIOException(ModbusException):
    """No valid answer came.

    Attributes:
        fcode: function code of the request, if it is known.
        dev_id: unit that was asked; 0 if it is not known.
    """

    def __init__(
        self, string: str = "", function_code: int | None = None, *, transaction_id: int = 0, dev_id: int = 0
    ) -> None:
        self.fcode: int | None = function_code
        self.transaction_id: int = transaction_id
        self.dev_id: int = dev_id
        self.message: str = f"[Input/Output] {string}"
        super().__init__(self.message)


class ParameterException(ModbusException):
    """A parameter is invalid."""

    def __init__(self, string: str = "") -> None:
        super().__init__(f"[Invalid Parameter] {string}")


class NoSuchIdException(ModbusException):
    """A server has no such unit."""

    def __init__(self, string: str = "") -> None:
        super().__init__(f"[No Such id] {string}")


NoSuchSlaveException = NoSuchIdException


class NotImplementedException(ModbusException):
    """The function is not offered."""

    def __init__(self, string: str = "") -> None:
        super().__init__(f"[Not Implemented] {string}")


class ConnectionException(ModbusException):
    """There is no connection, or it ended before the answer."""

    def __init__(self, string: str = "") -> None:
        super().__init__(f"[Connection] {string}")


class MessageRegisterException(ModbusException):
    """A class is no message that can be registered."""

    def __init__(self, string: str = "") -> None:
        super().__init__(f"[Error registering message] {string}")


def exception_for(error: ModbusError) -> ModbusException:
    """The exception of pymodbus that tells of an error of busway; the caller raises it from that error."""
    if isinstance(error, LinkDown) or isinstance(error.__cause__, LinkDown):
        return ConnectionException(str(error))
    return ModbusIOException(str(error), error.function, dev_id=error.unit or 0)

"""The exceptions of pymodbus, and which of them is raised for which error of busway. Knows nothing of clients."""

from ...errors import LinkDown, ModbusError


class ModbusException(Exception):
    """Base of the exceptions of pymodbus.

    Attributes:
        string: the message, without the words "Modbus Error" that `str` puts before it.
    """

    def __init__(self, string: str = "") -> None:
        self.string: str = string
        super().__init__(string)

    def __str__(self) -> str:
        return f"Modbus Error: {self.string}"

    def isError(self) -> bool:
        """Return True. Responses have this method too, so programs can call it on either."""
        return True


class ModbusIOException(ModbusException):
    """No valid reply was received.

    Attributes:
        fcode: function code of the request; None if it is not known.
        transaction_id: transaction identifier that the program gave; 0 if it gave none.
        dev_id: unit of the request; 0 if it is not known.
        message: the message as text.
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
    """An argument is invalid."""

    def __init__(self, string: str = "") -> None:
        super().__init__(f"[Invalid Parameter] {string}")


class NoSuchIdException(ModbusException):
    """A server has no context for a unit."""

    def __init__(self, string: str = "") -> None:
        super().__init__(f"[No Such id] {string}")


NoSuchSlaveException = NoSuchIdException


class NotImplementedException(ModbusException):
    """A function is not offered; programs may raise it."""

    def __init__(self, string: str = "") -> None:
        super().__init__(f"[Not Implemented] {string}")


class ConnectionException(ModbusException):
    """There is no connection, or it ended before the reply."""

    def __init__(self, string: str = "") -> None:
        super().__init__(f"[Connection] {string}")


class MessageRegisterException(ModbusException):
    """A class cannot be registered for responses: it is no `ModbusPDU`."""

    def __init__(self, string: str = "") -> None:
        super().__init__(f"[Error registering message] {string}")


def exception_for(error: ModbusError) -> ModbusException:
    """Create the exception of pymodbus for an error of busway; the caller raises it from that error.

    It is `ConnectionException` if there was no connection or it ended, otherwise `ModbusIOException`.
    """
    if isinstance(error, LinkDown) or isinstance(error.__cause__, LinkDown):
        return ConnectionException(str(error))
    return ModbusIOException(str(error), error.function, dev_id=error.unit or 0)

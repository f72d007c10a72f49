"""Files of records and queues of registers (Application Protocol V1.1b3 §6.14, §6.15, §6.18).

Knows their records and registers; knows no request. A record is one register; a file has records 0…9999 and a number
1…65535.
"""

import threading
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence

from ..codes import MAX_FILE_RECORD_NUMBER, TABLE_SIZE, ExceptionCode
from ..errors import ConfigError, InvalidRequest
from ..pdu.device_interface import Refusal
from ..pdu.write_items import pack_registers
from ..values.unfit_values import shown
from .address_map import AddressMap, map_of_registers
from .change_groups import Groups
from .memory_runs import Run
from .table_declaration import TableLike, lay_out
from .table_view import TableView


class RecordFile(TableView):
    """One file of a device: its records by number, ``file[3]`` or ``file[0:5]``, as in `TableView`.

    Attributes:
        is_consistent: False while the file area is known to be damaged: then every Modbus access to the file is refused
            with exception 08. The application's own accesses still work.
    """

    __slots__ = ("is_consistent",)

    def __init__(self, number: int, address_map: AddressMap, groups: Groups) -> None:
        super().__init__(f"file {number}", address_map, groups, bits=False)
        self.is_consistent: bool = True

    def accessed(self, record: int, count: int, *, writes: bool) -> Run:
        """Return the memory of ``count`` records from ``record`` on, for a request to read or write them.

        Raises:
            Refusal: 03 if ``count`` is 0, 02 if a record is missing (or is read-only and ``writes`` is True), 08 if the
                file is not consistent.
        """
        if count == 0:
            raise Refusal(ExceptionCode.ILLEGAL_DATA_VALUE, "no records are asked for")
        run = self._address_map.find(record, count)
        if run is None or (writes and self._address_map.is_read_only(record, count)):
            raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS, f"{self._name}, records {record}…{record + count - 1}")
        if not self.is_consistent:
            raise Refusal(ExceptionCode.MEMORY_PARITY_ERROR, f"{self._name} is not consistent")
        return run


class RegisterQueue:
    """A queue of registers, each 0…65535, that Modbus reads with function 24 and only the application changes.

    Function 24 returns up to 31 registers and leaves them in the queue; a queue with more is answered with
    exception 03. Each method is one step for every thread.

    Args:
        values: the registers in the queue at first, oldest first.
        lock: taken for every access.
    """

    __slots__ = ("_lock", "_values")

    def __init__(self, values: Iterable[int], lock: threading.RLock) -> None:
        self._lock = lock
        self._values: deque[int] = deque()
        self.push(*values)

    def push(self, *values: int) -> None:
        """Append registers to the queue. Raises `InvalidRequest` for a value outside 0…65535; then none is appended."""
        pack_registers(values)
        with self._lock:
            self._values.extend(values)

    def pop(self) -> int:
        """Remove and return the oldest register of the queue. Raises `IndexError` if the queue is empty."""
        with self._lock:
            return self._values.popleft()

    def clear(self) -> None:
        """Remove all registers from the queue."""
        with self._lock:
            self._values.clear()

    def __len__(self) -> int:
        return len(self._values)

    def __iter__(self) -> Iterator[int]:
        """Iterate over the current registers of the queue, oldest first."""
        with self._lock:
            return iter(list(self._values))


def build_files(
    declared: Mapping[int, TableLike] | None, lock: threading.RLock, groups: Groups
) -> dict[int, RecordFile]:
    """Create the files of a device, by number, from their declarations (see `lay_out`).

    Raises `ConfigError` for a wrong number or declaration.
    """
    files = {}
    for number, cells in (declared or {}).items():
        key = f"files[{shown(number)}]"
        if not isinstance(number, int) or not 1 <= number <= 0xFFFF:
            raise ConfigError(f"a file has a number 1…65535, not {shown(number)}", key="files")
        layout = lay_out(cells, key=key, size=MAX_FILE_RECORD_NUMBER + 1)
        files[number] = RecordFile(number, map_of_registers(layout, lock), groups)
    return files


def build_queues(declared: Mapping[int, Sequence[int]] | None, lock: threading.RLock) -> dict[int, RegisterQueue]:
    """Create the register queues of a device, by address. Raises `ConfigError` for a wrong declaration."""
    queues = {}
    for address, values in (declared or {}).items():
        if not isinstance(address, int) or not 0 <= address < TABLE_SIZE:
            raise ConfigError(f"a queue has an address 0…65535, not {shown(address)}", key="fifos")
        try:
            queues[address] = RegisterQueue(values, lock)
        except (InvalidRequest, TypeError) as error:
            raise ConfigError(f"a queue is a list of registers 0…65535: {error}", key=f"fifos[{address}]") from error
    return queues

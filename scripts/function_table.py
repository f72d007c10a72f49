"""Writes the table of docs/reference/functions.md from ``busway.STANDARD``. With ``--check``: only compares.

Knows the declarations of the functions and the page; nothing in the table is written by hand but the methods' names.
"""

from marked import ROOT, replaced, update

import busway
from busway.codes import FunctionCode, MeiType

METHODS = {
    FunctionCode.READ_COILS: "read_coils",
    FunctionCode.READ_DISCRETE_INPUTS: "read_discrete_inputs",
    FunctionCode.READ_HOLDING_REGISTERS: "read_holding_registers",
    FunctionCode.READ_INPUT_REGISTERS: "read_input_registers",
    FunctionCode.WRITE_SINGLE_COIL: "write_single_coil",
    FunctionCode.WRITE_SINGLE_REGISTER: "write_single_register",
    FunctionCode.READ_EXCEPTION_STATUS: "read_exception_status",
    FunctionCode.DIAGNOSTICS: "diagnostics",
    FunctionCode.GET_COMM_EVENT_COUNTER: "get_comm_event_counter",
    FunctionCode.GET_COMM_EVENT_LOG: "get_comm_event_log",
    FunctionCode.WRITE_MULTIPLE_COILS: "write_multiple_coils",
    FunctionCode.WRITE_MULTIPLE_REGISTERS: "write_multiple_registers",
    FunctionCode.REPORT_SERVER_ID: "report_server_id",
    FunctionCode.READ_FILE_RECORD: "read_file_record",
    FunctionCode.WRITE_FILE_RECORD: "write_file_record",
    FunctionCode.MASK_WRITE_REGISTER: "mask_write_register",
    FunctionCode.READ_WRITE_MULTIPLE_REGISTERS: "read_write_multiple_registers",
    FunctionCode.READ_FIFO_QUEUE: "read_fifo_queue",
    FunctionCode.ENCAPSULATED_INTERFACE: "execute",
    (FunctionCode.ENCAPSULATED_INTERFACE, MeiType.READ_DEVICE_IDENTIFICATION): "read_device_identification",
}
"""The method of `busway.BlockingUnit` that sends the function; ``execute`` sends any."""


def render() -> str:
    """The table."""
    lines = ["| code | function | method of a unit |", "| --- | --- | --- |"]
    for code in busway.STANDARD.codes():
        rows = [one for one in busway.STANDARD if one.code == code]
        if code == FunctionCode.DIAGNOSTICS:
            numbers = ", ".join(f"{one.sub_code:02X}" for one in rows)
            lines.append(f"| {code:02} | Diagnostics, sub-functions {numbers} | `{METHODS[code]}` |")
            continue
        for one in rows:
            sub_code = one.sub_code
            shown = f"{code:02}" if sub_code is None else f"{code:02}/{sub_code}"
            method = METHODS.get((code, sub_code), METHODS[code])
            if not hasattr(busway.BlockingUnit, method):
                raise SystemExit(f"{one.__name__}: a unit has no method {method}")
            lines.append(f"| {shown} | {title(one)} | `{method}` |")
    return "\n".join(lines)


def title(function: type[busway.Request]) -> str:
    """The name of a function as its docstring gives it: what stands between the code and the details."""
    first = (function.__doc__ or function.__name__).splitlines()[0]
    name = first.split(" ", 1)[1]
    for mark in (":", " (", "."):
        name = name.split(mark, 1)[0]
    return name


if __name__ == "__main__":
    file = ROOT / "docs" / "reference" / "functions.md"
    update(file, replaced(file.read_text(encoding="utf-8"), "functions", render()))

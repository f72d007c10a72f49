"""busway: Modbus clients, servers, gateways, simulators and a collector of values.

>>> import busway
>>> with busway.connect("tcp://10.0.0.5") as link:          # doctest: +SKIP
...     link.unit(1).read_holding_registers(0, count=10)

A name's module is imported when the name is first used, so ``import busway`` costs little. The names in ``__all__`` are
the public interface; everything else may change.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .interpreter import refuse_free_threading
from .version import __version__

refuse_free_threading()

if TYPE_CHECKING:
    from .access.addresses import AddressList
    from .access.audit_log import AuditLog
    from .access.authorizer import PolicyAuthorizer
    from .access.rules import Policy, Rule
    from .apps.collector.collector import Collector, collect
    from .apps.collector.store.store_reader import Store
    from .apps.control.service import Control
    from .apps.gateway.configuration import load_gateway, simple_gateway
    from .apps.gateway.gateway import Gateway
    from .apps.service.configuration import Configuration, load_configuration
    from .client.aio import AsyncLink, AsyncUnit
    from .client.aio import open_link as open
    from .client.blocking import BlockingLink, BlockingUnit, connect
    from .client.open_connections import LocalConnectionStatus, limit_local_connections, local_connections
    from .client.option_types import LinkOptions
    from .client.scanning import FoundUnit, scan
    from .codes import DiagnosticCode, ExceptionCode, FunctionCode, Table
    from .errors import (
        BadReply,
        ConfigError,
        ExceptionReply,
        InvalidRequest,
        LinkClosed,
        LinkDown,
        MissingExtra,
        ModbusError,
        NoAnswer,
        NoReply,
        Overloaded,
        UnitSuspended,
        WriteOutcomeUnknown,
    )
    from .observe.metrics.http_endpoint import start_metrics
    from .observe.trace import TRACE, TraceLevel
    from .options.endpoints import Endpoint, parse_endpoint
    from .options.server import ListenerParameters
    from .options.tls import TlsParameters
    from .pdu.device_interface import Refusal
    from .pdu.diagnostics import (
        GetCommEventCounter,
        GetCommEventLog,
        ReadExceptionStatus,
        ReportServerId,
        ReturnQueryData,
    )
    from .pdu.encapsulated import CanopenGeneralReference, ReadDeviceIdentification
    from .pdu.fields import repeated, rest, rest_length, u8, u16
    from .pdu.file_records import FileReference, ReadFileRecord, WriteFileRecord
    from .pdu.functions import STANDARD, FunctionTable
    from .pdu.message import Message, ReplyMessage, Request, Touch
    from .pdu.read_items import (
        ReadCoils,
        ReadDiscreteInputs,
        ReadFifoQueue,
        ReadHoldingRegisters,
        ReadInputRegisters,
    )
    from .pdu.server_id import ServerId
    from .pdu.unknown_functions import OpaqueRequest
    from .pdu.write_items import (
        MaskWriteRegister,
        ReadWriteMultipleRegisters,
        WriteMultipleCoils,
        WriteMultipleRegisters,
        WriteSingleCoil,
        WriteSingleRegister,
    )
    from .server.device import Device
    from .server.hooks import Access, Change
    from .server.listener import Listener
    from .server.option_types import ServerOptions
    from .server.server import Server
    from .server.serving import ServerThread, serve, serve_forever, serve_in_thread
    from .server.single_block import SingleBlock
    from .server.table_declaration import Cells
    from .session.call import CallOptions
    from .session.responder import LATER, SILENCE, RequestContext, ServedUnit
    from .values import Address, ValueType, parse_address, value_type
    from .values.constants import (
        BCD16,
        BCD32,
        BCD64,
        BITS,
        FLOAT16,
        FLOAT32,
        FLOAT64,
        INT16,
        INT32,
        INT64,
        UINT16,
        UINT32,
        UINT64,
        string,
    )

_HOME = {
    "apps.service.configuration": ("Configuration", "load_configuration"),
    "apps.collector.collector": ("Collector", "collect"),
    "apps.collector.store.store_reader": ("Store",),
    "apps.gateway.configuration": ("load_gateway", "simple_gateway"),
    "client.aio": ("AsyncLink", "AsyncUnit", "open"),
    "client.blocking": ("BlockingLink", "BlockingUnit", "connect"),
    "client.option_types": ("LinkOptions",),
    "client.open_connections": ("LocalConnectionStatus", "limit_local_connections", "local_connections"),
    "client.scanning": ("FoundUnit", "scan"),
    "codes": ("DiagnosticCode", "ExceptionCode", "FunctionCode", "Table"),
    "access.addresses": ("AddressList",),
    "access.rules": ("Policy", "Rule"),
    "options.endpoints": ("Endpoint", "parse_endpoint"),
    "apps.control.service": ("Control",),
    "errors": (
        "BadReply",
        "ConfigError",
        "ExceptionReply",
        "InvalidRequest",
        "LinkClosed",
        "LinkDown",
        "MissingExtra",
        "ModbusError",
        "NoAnswer",
        "NoReply",
        "Overloaded",
        "UnitSuspended",
        "WriteOutcomeUnknown",
    ),
    "apps.gateway.gateway": ("Gateway",),
    "observe.metrics.http_endpoint": ("start_metrics",),
    "observe.trace": ("TRACE", "TraceLevel"),
    "pdu.diagnostics": (
        "GetCommEventCounter",
        "GetCommEventLog",
        "ReadExceptionStatus",
        "ReportServerId",
        "ReturnQueryData",
    ),
    "pdu.encapsulated": ("CanopenGeneralReference", "ReadDeviceIdentification"),
    "pdu.fields": ("repeated", "rest", "rest_length", "u8", "u16"),
    "pdu.file_records": ("FileReference", "ReadFileRecord", "WriteFileRecord"),
    "pdu.functions": ("STANDARD", "FunctionTable"),
    "pdu.unknown_functions": ("OpaqueRequest",),
    "pdu.message": ("Message", "ReplyMessage", "Request", "Touch"),
    "pdu.device_interface": ("Refusal",),
    "pdu.read_items": (
        "ReadCoils",
        "ReadDiscreteInputs",
        "ReadFifoQueue",
        "ReadHoldingRegisters",
        "ReadInputRegisters",
    ),
    "pdu.server_id": ("ServerId",),
    "pdu.write_items": (
        "MaskWriteRegister",
        "ReadWriteMultipleRegisters",
        "WriteMultipleCoils",
        "WriteMultipleRegisters",
        "WriteSingleCoil",
        "WriteSingleRegister",
    ),
    "server.table_declaration": ("Cells",),
    "server.device": ("Device",),
    "server.hooks": ("Access", "Change"),
    "access.audit_log": ("AuditLog",),
    "server.listener": ("Listener",),
    "server.option_types": ("ServerOptions",),
    "options.server": ("ListenerParameters",),
    "access.authorizer": ("PolicyAuthorizer",),
    "server.server": ("Server",),
    "server.serving": ("ServerThread", "serve", "serve_forever", "serve_in_thread"),
    "server.single_block": ("SingleBlock",),
    "session.call": ("CallOptions",),
    "session.responder": ("LATER", "SILENCE", "RequestContext", "ServedUnit"),
    "options.tls": ("TlsParameters",),
    "values.constants": (
        "BCD16",
        "BCD32",
        "BCD64",
        "BITS",
        "FLOAT16",
        "FLOAT32",
        "FLOAT64",
        "INT16",
        "INT32",
        "INT64",
        "UINT16",
        "UINT32",
        "UINT64",
        "string",
    ),
    "values": ("Address", "ValueType", "parse_address", "value_type"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}
_REAL_NAME = {"open": "open_link"}

__all__ = [
    "BCD16",
    "BCD32",
    "BCD64",
    "BITS",
    "FLOAT16",
    "FLOAT32",
    "FLOAT64",
    "INT16",
    "INT32",
    "INT64",
    "LATER",
    "SILENCE",
    "STANDARD",
    "TRACE",
    "UINT16",
    "UINT32",
    "UINT64",
    "Access",
    "Address",
    "AddressList",
    "AsyncLink",
    "AsyncUnit",
    "AuditLog",
    "BadReply",
    "BlockingLink",
    "BlockingUnit",
    "CallOptions",
    "CanopenGeneralReference",
    "Cells",
    "Change",
    "Collector",
    "ConfigError",
    "Configuration",
    "Control",
    "Device",
    "DiagnosticCode",
    "Endpoint",
    "ExceptionCode",
    "ExceptionReply",
    "FileReference",
    "FoundUnit",
    "FunctionCode",
    "FunctionTable",
    "Gateway",
    "GetCommEventCounter",
    "GetCommEventLog",
    "InvalidRequest",
    "LinkClosed",
    "LinkDown",
    "LinkOptions",
    "Listener",
    "ListenerParameters",
    "LocalConnectionStatus",
    "MaskWriteRegister",
    "Message",
    "MissingExtra",
    "ModbusError",
    "NoAnswer",
    "NoReply",
    "OpaqueRequest",
    "Overloaded",
    "Policy",
    "PolicyAuthorizer",
    "ReadCoils",
    "ReadDeviceIdentification",
    "ReadDiscreteInputs",
    "ReadExceptionStatus",
    "ReadFifoQueue",
    "ReadFileRecord",
    "ReadHoldingRegisters",
    "ReadInputRegisters",
    "ReadWriteMultipleRegisters",
    "Refusal",
    "ReplyMessage",
    "ReportServerId",
    "Request",
    "RequestContext",
    "ReturnQueryData",
    "Rule",
    "ServedUnit",
    "Server",
    "ServerId",
    "ServerOptions",
    "ServerThread",
    "SingleBlock",
    "Store",
    "Table",
    "TlsParameters",
    "Touch",
    "TraceLevel",
    "UnitSuspended",
    "ValueType",
    "WriteFileRecord",
    "WriteMultipleCoils",
    "WriteMultipleRegisters",
    "WriteOutcomeUnknown",
    "WriteSingleCoil",
    "WriteSingleRegister",
    "__version__",
    "collect",
    "connect",
    "limit_local_connections",
    "load_configuration",
    "load_gateway",
    "local_connections",
    "open",
    "parse_address",
    "parse_endpoint",
    "repeated",
    "rest",
    "rest_length",
    "scan",
    "serve",
    "serve_forever",
    "serve_in_thread",
    "simple_gateway",
    "start_metrics",
    "string",
    "u8",
    "u16",
    "value_type",
]


def __getattr__(name: str) -> Any:  # any public name, of any type
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module 'busway' has no attribute {name!r}")
    value = getattr(import_module(f".{module}", __name__), _REAL_NAME.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

"""Bytes in, bytes out: sockets, serial ports and pairs in memory. Knows no Modbus."""

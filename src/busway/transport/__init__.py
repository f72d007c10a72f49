"""Transports: bytes in and out over sockets, serial ports and pairs in memory. Knows no Modbus."""

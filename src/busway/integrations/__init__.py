"""Integrations: interfaces that other projects define for Modbus libraries, implemented with busway's links.

===================  ===============================================================================================
`modbus_connection`  The backend of modbus-connection, which Home Assistant's integrations speak Modbus through
===================  ===============================================================================================

Each file imports the other project, and is imported by programs that use it; no file of busway imports it.
"""

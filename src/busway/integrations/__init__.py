"""Integrations: interfaces that other projects define for Modbus libraries, implemented with busway's links.

===================  ===============================================================================================
`modbus_connection`  The backend of modbus-connection, which Home Assistant's integrations speak Modbus through
===================  ===============================================================================================

Each file imports the other project. Only programs that use it import the file; no other file of busway does.
"""

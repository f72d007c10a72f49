"""Integrations: what other projects define and want a Modbus library to fill in, made of busway's own links.

===================  ===============================================================================================
`modbus_connection`  The backend of modbus-connection, which Home Assistant's integrations speak Modbus through
===================  ===============================================================================================

Each imports the other project, and is imported by who uses it; nothing in busway imports it.
"""

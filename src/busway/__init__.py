"""busway: a MODBUS messaging system."""

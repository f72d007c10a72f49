"""Messages: one class for each Modbus function, and the table that lists them. Start reading at ``read_items``."""

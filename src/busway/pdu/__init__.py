"""Messages: one class per function, and the table that lists them. Start reading at ``read_items``."""

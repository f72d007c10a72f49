"""One file per table. To add one: a module with `run(bench: Bench) -> Table`, and its line here."""

TABLES = {
    "server": "tables.server",
    "client": "tables.client",
    "line": "tables.line",
    "gateway": "tables.gateway",
    "connections": "tables.connections",
    "memory": "tables.memory",
    "startup": "tables.startup",
}

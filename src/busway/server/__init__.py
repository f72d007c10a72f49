"""Being a device: stores and hooks, the handler of local devices, connection management, listeners."""

"""Being a device: stores and hooks, the responder of local devices, connection management, listeners."""

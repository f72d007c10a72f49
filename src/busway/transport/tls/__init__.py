"""TLS on connections of our own: parameters, contexts, certificates, roles, and the failures of a handshake."""

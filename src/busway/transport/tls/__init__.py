"""TLS: contexts, certificates, roles of clients, handshakes, and the reasons for which they fail."""

"""One epoll object for all connections of an event loop. Without this folder the loop's own transports are used."""

"""All connections of a server in one epoll set. Delete this folder and the transports of the event loop serve."""

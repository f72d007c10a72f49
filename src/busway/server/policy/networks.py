"""Lists of addresses and networks, by the name that servers use; they are values of `busway.config.access`."""

from ...config.access.networks import Networks, host_of_peer

__all__ = ["Networks", "host_of_peer"]

"""Allow and deny lists, by the name that servers use; they are values of `busway.config.access`."""

from ...config.access.addresses import AddressList

__all__ = ["AddressList"]

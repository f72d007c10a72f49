"""Coordinators: backends that keep the rules of `busway.apps.fleet.coordinator`."""

from .opening import open_coordinator

__all__ = ["open_coordinator"]

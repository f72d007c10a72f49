"""Records which devices are in maintenance and therefore not polled: since when, who began it, and why.

Knows the manifest, the log and the audit log; pollers leave the devices alone.

1. Maintenance is recorded in the manifest before polling stops, so it goes on after a crash and a new start.
2. A maintenance is one interval of the device, from its begin to its end, also over restarts and reloads.
3. Begin and end of a maintenance are each a sentence in the log and a line of the audit log, with who and why.
"""

import json
import logging
import sqlite3
from collections.abc import Mapping
from dataclasses import replace

from ...access.audit_log import AuditLog
from ...errors import ConfigError
from .sample_clock import ClockCorrection
from .samples import NANOSECONDS, Reason, StateInterval
from .store.manifest import MaintenanceRow, Manifest

_log = logging.getLogger("busway.collector")


class MaintenanceBook:
    """Records which devices of a collector are in maintenance (not polled), in manifest, log and audit log.

    Args:
        manifest: the store's manifest, open for writing; the maintenance of earlier runs is read from it.
        audit: the audit log; each begin and end becomes a line.
    """

    def __init__(self, manifest: Manifest, audit: AuditLog) -> None:
        self._manifest, self._audit = manifest, audit
        self._rows = {row.device: row for row in manifest.maintenance()}

    @property
    def devices(self) -> Mapping[str, MaintenanceRow]:
        """The devices in maintenance now, by name, each with its begin, who began it, and why."""
        return self._rows

    def begin(self, device: str, at: int, by: str, why: str) -> MaintenanceRow:
        """Record that the maintenance of a device begins, and return the record; the caller stops polling the device.

        A device already in maintenance keeps its begin, and gets the new ``by`` and ``why``.

        Args:
            device: name of the device.
            at: the begin, nanoseconds since 1970 UTC.
            by: who begins the maintenance.
            why: the reason; may be empty.

        Raises:
            ConfigError: the store cannot be written; nothing has changed.
        """
        known = self._rows.get(device)
        row = MaintenanceRow(device, at if known is None else known.begin, by, why)
        self._record_begin(row)
        return row

    def take_over(self, row: MaintenanceRow) -> None:
        """Record the maintenance of a device that another collector has begun; does nothing if it is known.

        Raises:
            ConfigError: the store cannot be written; nothing has changed.
        """
        known = self._rows.get(row.device)
        if known is None or known.begin != row.begin:
            self._record_begin(row)

    def _record_begin(self, row: MaintenanceRow) -> None:
        try:
            self._manifest.begin_maintenance(row)
        except sqlite3.Error as error:
            raise ConfigError(f"the maintenance of {row.device} cannot be noted: {error}", key="device") from error
        self._rows[row.device] = row
        _log.warning("device %s is in maintenance: %s, by %s", row.device, row.why or "no reason given", row.by)
        self._audit_change(row, "begin", row.by, row.why, 0.0)

    def end(self, device: str, at: int, by: str, why: str) -> StateInterval:
        """Record that the maintenance of a device ends, and return its interval; the caller polls the device again.

        Args:
            device: name of a device that is in maintenance.
            at: the end, nanoseconds since 1970 UTC.
            by: who ends the maintenance.
            why: the reason; may be empty.

        Raises:
            ConfigError: the store cannot be written; the maintenance goes on.
            KeyError: the device is not in maintenance.
        """
        row = self._rows[device]
        try:
            self._manifest.end_maintenance(device)
        except sqlite3.Error as error:
            raise ConfigError(f"the end of maintenance of {device} cannot be noted: {error}", key="device") from error
        del self._rows[device]
        end = max(at, row.begin)
        seconds = (end - row.begin) / NANOSECONDS
        _log.warning(
            "maintenance of device %s has ended after %.0f s: %s, by %s; it began by %s: %s",
            device,
            seconds,
            why or "no reason given",
            by,
            row.by,
            row.why or "no reason given",
        )
        self._audit_change(row, "end", by, why, seconds)
        return StateInterval(device, row.begin, end, Reason.MAINTENANCE)

    def mend(self, correction: ClockCorrection) -> None:
        """Correct each begin of a maintenance that was recorded before the wall clock was right, in memory only.

        The manifest corrects its own records.
        """
        for row in list(self._rows.values()):
            self._rows[row.device] = replace(row, begin=correction.corrected(row.begin))

    def _audit_change(self, row: MaintenanceRow, what: str, by: str, why: str, seconds: float) -> None:
        line = {
            "time": self._audit.timestamp(),
            "event": "maintenance",
            "by": by,
            "device": row.device,
            "what": what,
            "why": why,
            "seconds": round(seconds, 3),
        }
        self._audit.append(json.dumps(line, ensure_ascii=True) + "\n")

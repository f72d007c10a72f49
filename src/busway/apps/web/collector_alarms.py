"""The alarms of a collector and the maintenance of its devices, over HTTP.

Knows a running collector and the form of responses. `request_guard` decides which caller may do what.
"""

from typing import Annotated, Final

from fastapi import Depends, FastAPI, Query
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException

from ...errors import ConfigError, InvalidRequest, Overloaded
from ..collector.alarms.events import AlarmEvent, RaisedAlarm
from ..collector.collector import Collector
from ..collector.samples import quality_of, reason_text
from .messages import Answer, Failure, Plain, plain_value
from .request_guard import Caller, Role, require

_MILLION: Final = 1_000_000
MOST_EVENTS: Final = 1000


class _Question(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class AcknowledgementQuestion(_Question):
    """Request to acknowledge an alarm: which one."""

    device: str = Field(max_length=200)
    point: str = Field(max_length=200)
    limit: str = Field(max_length=10)


class MaintenanceQuestion(_Question):
    """Request to begin or end the maintenance of a device, and why."""

    on: bool
    reason: str = Field(min_length=1, max_length=500)


class AcknowledgedAnswer(Answer):
    """Response: who acknowledged an alarm, and when."""

    by: str
    at: int


class AlarmAnswer(Answer):
    """Response: an alarm that is active or not acknowledged. Times are milliseconds since 1970 UTC."""

    device: str
    point: str
    limit: str
    state: str
    since: int
    value: Plain | None
    acknowledged: AcknowledgedAnswer | None
    needs_acknowledgement: bool = Field(description="Whether it waits for a person.")
    cleared: int | None
    text: str
    quality: str = Field(description="Of the last sample of the point: a bad one raises and clears nothing.")
    reason: str


class AlarmEventAnswer(Answer):
    """Response: a line of the journal of alarms."""

    at: int
    device: str
    point: str
    limit: str
    event: str
    value: Plain | None
    by: str
    text: str


class AlarmsAnswer(Answer):
    """Response: alarms, the one raised last first, and the newest lines of their journal."""

    active: list[AlarmAnswer]
    journal: list[AlarmEventAnswer]


class MaintenanceAnswer(Answer):
    """Response: whether a device is in maintenance, since when, by whom and why."""

    device: str
    on: bool
    since: int | None
    by: str
    reason: str


class AlarmApi:
    """Routes of the collector's page for alarms and the maintenance of devices."""

    def __init__(self, collector: Collector) -> None:
        self._collector = collector

    def add_to(self, application: FastAPI) -> None:
        """Add the routes for alarms and maintenance to a FastAPI application."""
        add = application.add_api_route
        refused = {"model": Failure, "description": "There is no such alarm or device, or the store cannot be written."}
        add("/api/alarms", self.list_alarms, methods=["GET"], summary="Alarms, and the newest lines of the journal")
        add(
            "/api/alarms/acknowledge",
            self.acknowledge,
            methods=["POST"],
            summary="Acknowledge an alarm",
            responses={404: refused, 503: refused},
        )
        add("/api/maintenance", self.list_maintenance, methods=["GET"], summary="Devices in maintenance")
        add(
            "/api/devices/{device}/maintenance",
            self.set_maintenance,
            methods=["POST"],
            summary="Begin or end the maintenance of a device",
            responses={404: refused, 503: refused},
        )

    async def list_alarms(self, limit: Annotated[int, Query(ge=0, le=MOST_EVENTS)] = 100) -> AlarmsAnswer:
        """Return the alarms that are active or not acknowledged, and the newest alarm events; newest first in both."""
        alarms = self._collector.alarms
        return AlarmsAnswer(
            active=[_alarm(each, alarms.reason(each.key)) for each in reversed(alarms.active())],
            journal=[_event(each) for each in alarms.journal(limit)],
        )

    async def acknowledge(
        self, question: AcknowledgementQuestion, caller: Annotated[Caller, Depends(require(Role.OPERATE))]
    ) -> AlarmEventAnswer:
        """Acknowledge an alarm, and return its event once the event is stored.

        404: there is no such alarm, or it needs no acknowledgement. 503: the store could not be written in time; the
        alarm is acknowledged nevertheless.
        """
        try:
            event = await self._collector.alarms.acknowledge(
                question.device, question.point, question.limit, caller.name
            )
        except InvalidRequest as error:
            raise HTTPException(404, error.message) from error
        except Overloaded as error:
            raise HTTPException(503, error.message) from error
        return _event(event)

    async def list_maintenance(self) -> list[MaintenanceAnswer]:
        """Return the devices in maintenance: since when, who began it, and why."""
        polled = self._collector.configuration.devices  # in a fleet, others are another collector's
        return [self._maintenance_of(device) for device in self._collector.in_maintenance() if device in polled]

    async def set_maintenance(
        self, device: str, question: MaintenanceQuestion, caller: Annotated[Caller, Depends(require(Role.OPERATE))]
    ) -> MaintenanceAnswer:
        """Begin or end the maintenance of a device, and return whether it is in maintenance.

        A device in maintenance is not polled. 404: unknown device; 503: the store cannot be written.
        """
        if device not in self._collector.configuration.devices:
            raise HTTPException(404, f"there is no device {device}")
        try:
            self._collector.maintenance(device, begins=question.on, by=caller.name, why=question.reason)
        except ConfigError as error:
            raise HTTPException(503, error.message) from error
        return self._maintenance_of(device)

    def _maintenance_of(self, device: str) -> MaintenanceAnswer:
        row = self._collector.in_maintenance().get(device)
        if row is None:
            return MaintenanceAnswer(device=device, on=False, since=None, by="", reason="")
        return MaintenanceAnswer(device=device, on=True, since=row.begin // _MILLION, by=row.by, reason=row.why)


def _alarm(alarm: RaisedAlarm, reason: int) -> AlarmAnswer:
    acknowledged = None
    if alarm.acknowledged_by is not None and alarm.acknowledged_at is not None:
        acknowledged = AcknowledgedAnswer(by=alarm.acknowledged_by, at=alarm.acknowledged_at // _MILLION)
    return AlarmAnswer(
        device=alarm.device,
        point=alarm.point,
        limit=alarm.limit,
        state=alarm.state.value,
        since=alarm.since // _MILLION,
        value=plain_value(alarm.value),
        acknowledged=acknowledged,
        needs_acknowledgement=alarm.state.is_unacknowledged,
        cleared=None if alarm.cleared_at is None else alarm.cleared_at // _MILLION,
        text=alarm.text,
        quality=quality_of(reason).label,
        reason=reason_text(reason),
    )


def _event(event: AlarmEvent) -> AlarmEventAnswer:
    return AlarmEventAnswer(
        at=event.at // _MILLION,
        device=event.device,
        point=event.point,
        limit=event.limit,
        event=event.kind.value,
        value=plain_value(event.value),
        by=event.by,
        text=event.text,
    )

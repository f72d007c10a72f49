"""The fleet on the page of one of its collectors, and over HTTP.

A zone is a group of collectors that share the links of a plant; a shard is a group of links that one collector owns and
polls. The page shows owners, epochs (numbers of ownerships), loads, how far sinks are behind, and holes (times without
an owner). Knows the zone from its coordinator, and the form of responses; asks no collector.
"""

import asyncio
import math
import time
from collections.abc import Awaitable, Callable
from typing import Final

from fastapi import FastAPI
from pydantic import Field

from ..fleet.zone_watch import ZoneWatch
from .messages import Answer

MOST_SHARDS: Final = 1100
NEWEST_SECONDS: Final = 2.0
"""Shortest time in seconds between two requests for the number of the newest message of the stream, for all pages."""


class FleetCollectorAnswer(Answer):
    """Response: one collector of a zone."""

    name: str
    host: str
    state: str = Field(description="polls, drains, refuses, silent or ended.")
    problem: str = Field(description="Why it owns nothing; empty while it may.")
    shards: int
    load: float = Field(description="Seconds of line time in a second that its shards need.")
    behind: int = Field(description="Commits of its store that not all sinks have; 0 without a stream.")
    revision: int = Field(description="Of the configuration that it works by.")


class FleetShardAnswer(Answer):
    """Response: one shard (group of links) and its owner."""

    shard: str
    owner: str = Field(description="Empty while it is free.")
    epoch: str = Field(description="Number of the ownership; each later owner has a greater one.")
    load: float


class FleetHoleAnswer(Answer):
    """Response: a time in which no collector owned a shard. Times are milliseconds since 1970 UTC."""

    shard: str
    before: str
    after: str
    was_silent: bool = Field(description="Whether the owner fell silent; it gave the shard back otherwise.")
    begin: int
    end: int
    epoch: str


class FleetSinkAnswer(Answer):
    """Response: how far a sink of the zone has come in the stream."""

    name: str
    taken: int = Field(description="Number of the last message that it has taken.")
    behind: int | None = Field(description="Messages of the stream that it has not taken; null if not known.")


class FleetAnswer(Answer):
    """Response: a zone of a fleet, as its coordinator shows it."""

    now: int
    is_complete: bool = Field(description="False while the coordinator is away: all is as it was known last.")
    configuration: str
    revision: int
    collectors: list[FleetCollectorAnswer]
    shards: list[FleetShardAnswer]
    holes: list[FleetHoleAnswer] = Field(description="Since this collector began, the newest first.")
    sinks: list[FleetSinkAnswer]


class FleetApi:
    """The route of a collector's page that shows its zone: the collectors that share the links of a plant.

    Args:
        watch: the state of the zone by its coordinator, kept up to date.
        newest: returns the number of the newest message of the zone's stream, None if it is not known; called at most
            every `NEWEST_SECONDS`. None for a zone without a stream.

    Attributes:
        name: the name of the page's module.
    """

    name: Final = "fleet"

    def __init__(self, watch: ZoneWatch, newest: Callable[[], Awaitable[int | None]] | None = None) -> None:
        self._watch, self._newest = watch, newest
        self._known: int | None = None
        self._asked_at = -math.inf
        self._asking = asyncio.Lock()

    def add_to(self, application: FastAPI) -> None:
        """Add the route ``/api/fleet`` to a FastAPI application."""
        application.add_api_route("/api/fleet", self.get_fleet, methods=["GET"], summary="The zone of the fleet")

    async def get_fleet(self) -> FleetAnswer:
        """Return the collectors of the zone, the owner of each shard, times without an owner, and the sinks.

        At most `MOST_SHARDS` shards are listed.
        """
        status, newest = self._watch.status(), await self._newest_message()
        return FleetAnswer(
            now=time.time_ns() // 1_000_000,
            is_complete=self._watch.is_complete,
            configuration=status.configuration,
            revision=status.revision,
            collectors=[
                FleetCollectorAnswer(
                    name=each.record.name,
                    host=each.record.host,
                    state=each.state,
                    problem=each.record.problem,
                    shards=len(each.shards),
                    load=each.load,
                    behind=each.record.behind,
                    revision=each.record.revision,
                )
                for each in status.members.values()
            ],
            shards=[
                FleetShardAnswer(
                    shard=shard, owner=each.owner if each.held else "", epoch=str(each.epoch or ""), load=each.cost
                )
                for shard, each in list(status.leases.items())[:MOST_SHARDS]
            ],
            holes=[
                FleetHoleAnswer(
                    shard=each.shard,
                    before=each.before,
                    after=each.after,
                    was_silent=each.was_silent,
                    begin=int(1000 * each.begin),
                    end=int(1000 * each.end),
                    epoch=str(each.epoch),
                )
                for each in self._watch.holes()
            ],
            sinks=[
                FleetSinkAnswer(name=name, taken=taken, behind=None if newest is None else max(0, newest - taken))
                for name, taken in self._watch.sinks().items()
            ],
        )

    async def _newest_message(self) -> int | None:
        async with self._asking:
            now = time.monotonic()
            if self._newest is not None and now - self._asked_at >= NEWEST_SECONDS:
                self._known = await self._newest()
                self._asked_at = time.monotonic()
            return self._known

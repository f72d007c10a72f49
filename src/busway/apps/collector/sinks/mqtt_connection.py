"""Connects MQTT clients (aiomqtt), and closes connections that were opened but cannot be used.

Knows the library's client and the socket of paho below it; knows no topic.

1. The library leaves the socket and a task of a client open that gets no answer, or is cancelled, while it connects.
   Such a client is closed here.
2. The thread in which it connects cannot be stopped: who gives up waits `GIVE_UP_SECONDS` for it, not longer.
"""

import asyncio
from typing import Any, Final

GIVE_UP_SECONDS: Final = 0.5


async def connect(client: Any) -> None:  # aiomqtt is loaded when it is used
    """Connect an MQTT client to its broker; leaving the client's context disconnects it.

    Raises:
        aiomqtt.MqttError, OSError: it is not connected, and closed.
    """
    connecting = asyncio.ensure_future(client.__aenter__())
    try:
        await asyncio.shield(connecting)
    except BaseException:
        await asyncio.wait([connecting], timeout=GIVE_UP_SECONDS)
        below = client._client  # paho's: the library's own disconnecting waits for a connection that there never was
        below.disconnect()
        below.loop_write()  # which closes the socket
        connecting.cancel()
        await asyncio.wait([connecting])
        raise

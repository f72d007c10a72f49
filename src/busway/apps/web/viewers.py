"""The WebSockets of open pages: how a viewer of any page is accepted, served and closed.

A viewer is one open page. Knows WebSockets, the access rules and limits of time; knows no message of a page.

1. A viewer whose token is removed or has another role is sent nothing more, and its WebSocket is closed; the page then
   connects again.
2. A viewer must take a message within `SEND_SECONDS`, or its WebSocket is closed.
"""

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from typing import Any, Final

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from .connections import MOST_VIEWERS, PROTOCOL, SEND_SECONDS
from .request_guard import BEARER_PROTOCOL, POLICY_VIOLATION, caller_of, current_caller

TRY_AGAIN_LATER: Final = 1013
UNSUPPORTED: Final = 1003


class Gone(Exception):
    """Error: the WebSocket of a viewer was closed, so it can be sent nothing more."""


async def accept(socket: WebSocket, present: int) -> bool:
    """Accept the WebSocket of one more open page, and return True.

    If there are `MOST_VIEWERS` already, close the WebSocket at once, and return False.

    Args:
        socket: the WebSocket.
        present: number of viewers without the new one.
    """
    if present >= MOST_VIEWERS:
        await socket.close(TRY_AGAIN_LATER, f"there are {MOST_VIEWERS} already")
        return False
    offered = socket.scope.get("subprotocols", [])
    shows_token = any(one.startswith(BEARER_PROTOCOL) for one in offered)
    await socket.accept(PROTOCOL if PROTOCOL in offered or shows_token else None)
    return True


async def converse(socket: WebSocket, sending: Coroutine[Any, Any, None], take: Callable[[str], str]) -> None:
    """Serve the WebSocket of a viewer until it ends, or a message of the viewer is refused.

    Args:
        socket: the accepted WebSocket.
        sending: coroutine that sends messages to the viewer; run as a task, which is cancelled at the end.
        take: called with each text from the viewer; returns why the text is refused, or an empty text. A refusal closes
            the WebSocket.
    """
    sender = asyncio.create_task(sending)
    try:
        await _receive(socket, take)
    except WebSocketDisconnect:
        pass
    finally:
        sender.cancel()
        await asyncio.gather(sender, return_exceptions=True)


async def _receive(socket: WebSocket, take: Callable[[str], str]) -> None:
    while True:
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            return
        text = message.get("text")
        problem = "what was sent is no text" if text is None else take(text)
        if problem:
            await close(socket, UNSUPPORTED, problem)
            return


async def check(socket: WebSocket) -> None:
    """Check that the token of a viewer is still valid, with the same role as when its WebSocket was opened.

    Otherwise close the WebSocket and raise `Gone`.
    """
    if current_caller(socket.scope) != caller_of(socket.scope):
        await close(socket, POLICY_VIOLATION, "what its token permits has changed")
        raise Gone


async def send(socket: WebSocket, text: str) -> None:
    """Send a text to a viewer, after `check`.

    Raises:
        Gone: the token has changed, or the viewer did not take the text within `SEND_SECONDS`; the WebSocket is closed.
    """
    await check(socket)
    try:
        async with asyncio.timeout(SEND_SECONDS):
            await socket.send_text(text)
    except TimeoutError:
        await close(socket, TRY_AGAIN_LATER, "it takes nothing")
        raise Gone from None


async def close(socket: WebSocket, code: int, reason: str) -> None:
    """Close the WebSocket of a viewer with a close code and a reason; does nothing if it has ended already."""
    with contextlib.suppress(RuntimeError):  # it has ended meanwhile
        if socket.application_state is WebSocketState.CONNECTED:
            await socket.close(code, reason)

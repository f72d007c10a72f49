"""Makes the class of NATS clients (nats-py) that all connections to NATS servers use.

1. If the URL asks for TLS, nothing is sent to a server that offers none. The library alone encrypts only if the server
   asks for it; else it sends name, password and token in clear text, even to an impostor.
2. If connecting is refused, the connection is closed; the library alone would leave its socket open.
"""

from functools import cache
from importlib import import_module
from typing import Any


@cache
def nats_client_kind() -> Any:  # Any: the package is loaded when it is used
    """Return the class of NATS clients to use: a subclass of nats-py's client that keeps the rules of this file.

    Set ``must_encrypt`` of a client before `connect`: whether nothing may be sent to a server that offers no TLS.
    """
    nats = import_module("nats")

    class EncryptingClient(nats.NATS):  # type: ignore[misc, name-defined] # as above
        must_encrypt: bool = False

        async def _process_connect_init(self) -> None:
            try:
                await super()._process_connect_init()
            except BaseException:
                if self._transport is not None:
                    self._transport.close()
                raise

        def _connect_command(self) -> bytes:
            """Return the first bytes that the library sends to a server, which contain the credentials.

            Raises an error of the library if ``must_encrypt`` is set and the server offers no TLS.
            """
            if self.must_encrypt and not self._server_info.get("tls_required"):
                raise nats.errors.Error("it offers no TLS, which the URL asks for; nothing was sent")
            command: bytes = super()._connect_command()
            return command

    return EncryptingClient

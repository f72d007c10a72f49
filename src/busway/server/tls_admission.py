"""Admits clients of a TLS listener: runs the handshakes and checks host, certificate and role.

Knows connections that are not admitted yet; knows no request. The rights of a role are decided by the policy.

1. Order: address (before a byte is read) → a handshake slot → TLS, with a client's certificate → its role → a
   connection slot. Every refusal is counted by its reason and logged: one line a minute for the same host and reason,
   with the number of refusals.
2. The TLS context is read when a connection is accepted: changed certificates and authorities apply from the next
   connection on, and open connections are not disturbed.
3. At most ``max_handshakes`` are pending; a new connection replaces the oldest of them, so that clients that stall
   cannot keep others out. The handshake of a priority host is replaced only by that of another priority host.
4. A resumed session presents the certificate of its first handshake; its validity is checked again.
"""

import asyncio
import logging
from collections import Counter
from time import time as now  # by a name that tests can move
from typing import Final, cast

from ..options.networks import host_of, peer_name
from ..options.tls import TlsParameters
from ..transport.tls.certificates.facts import DAY, CertificateFacts, facts_of_der, facts_of_file
from ..transport.tls.context import server_context
from ..transport.tls.failures import FailureKind, TlsFailure
from ..transport.tls.layer import TlsLayer, TlsState
from ..transport.tls.renewal import WatchedContext
from ..transport.tls.roles import require_cryptography, role_of_certificate
from .connection import Certified, ServerConnection
from .connection_management import ConnectionManagement
from .status import SecurityStatus

_log = logging.getLogger("busway.server")

_FIRST_SUBJECT: Final = 0


def tls_admission(management: ConnectionManagement, parameters: TlsParameters) -> "TlsAdmission":
    """Create the TLS admission of a listener and put it into ``management``, for reload, status and close.

    Called for each accepted connection, it returns the connection's protocol.

    Raises:
        ConfigError: a file cannot be used, or ``cryptography`` is missing.
    """
    management.tls_admission = made = TlsAdmission(management, parameters)
    return made


class TlsAdmission:
    """Runs the TLS handshakes of one listener and admits clients. Created by `tls_admission`."""

    def __init__(self, management: ConnectionManagement, parameters: TlsParameters) -> None:
        require_cryptography("a tls:// listener")
        self._management = management
        self._parameters = parameters
        self._context = WatchedContext(parameters, server_context, name=management.listener)
        self._own: CertificateFacts | None = None
        self._own_of = -1
        self._warned = 0.0
        self._waiting: dict[TlsLayer, str] = {}  # pending handshakes, oldest first, each with its peer
        self._strangers: dict[TlsLayer, None] = {}  # of these, those that are not of priority hosts
        self._leaving: dict[TlsLayer, None] = {}  # refused, and given a moment to read why
        self._refused: Counter[str] = Counter()
        self._established = 0
        self._resumed = 0
        self._without_role = 0
        self._look_at_own()

    def __call__(self) -> asyncio.BaseProtocol:
        """Return the asyncio protocol for an accepted connection, which runs its TLS handshake."""
        return _PendingHandshake(self)

    def reload(self) -> None:
        """Read the listener's certificate, key and authorities again.

        Raises `ConfigError`; then the old ones stay in use.
        """
        self._context.name = self._management.listener
        self._context.reload()
        self._look_at_own()

    def end_unauthorized(self) -> int:
        """Abort the handshakes of hosts that may no longer connect; returns their number."""
        may_stay = self._management.listener_context.may_stay
        ended = [
            layer
            for layer, peer in self._waiting.items()
            if not may_stay(host_of(layer.get_extra_info("peername")), peer)
        ]
        for layer in ended:
            layer.failure = TlsFailure(FailureKind.GONE, "its address is no longer authorized")
            layer.abort()
        return len(ended)

    def close(self) -> None:
        """Abort all TLS handshakes that are not complete."""
        for layer in list(self._waiting):
            layer.failure = TlsFailure(FailureKind.GONE, "the listener was closed")
            layer.abort()
        for layer in list(self._leaving):
            layer.abort()

    @property
    def pending(self) -> int:
        """Number of TLS handshakes in progress."""
        return len(self._waiting)

    def status(self) -> SecurityStatus:
        """Return the listener's TLS status: its certificate and counts of handshakes."""
        own = self._look_at_own()
        return SecurityStatus(
            subject=own.subject,
            not_after=own.not_after,
            days_left=own.days_left(now()),
            reloads=self._context.generation,
            handshakes=len(self._waiting),
            established=self._established,
            resumed=self._resumed,
            refused=dict(self._refused),
            without_role=self._without_role,
        )

    def _look_at_own(self) -> CertificateFacts:
        """Return what the listener's own certificate says; its file is read only after the TLS context was reloaded.

        Logs a warning if the certificate is not valid yet, has expired or expires within 30 days; that is checked after
        each reading and once a day.
        """
        context = self._context
        if self._own is None or self._own_of != context.generation:
            assert self._parameters.certificate is not None  # or there would be no context
            self._own = facts_of_file(self._parameters.certificate)[_FIRST_SUBJECT]
            self._own_of = context.generation
            self._warned = 0.0
        moment = now()
        if moment - self._warned >= DAY:
            self._warned = moment
            problem = self._own.validity(moment)
            if problem:
                name = self._management.listener
                _log.warning("%s: the certificate %s %s", name, self._own.subject, problem)
        return self._own

    # What new connections and their TLS report.

    def arrived(self, transport: asyncio.Transport) -> None:
        """Start the TLS handshake of an accepted connection, if its host may connect.

        If all ``max_handshakes`` are pending, the oldest of a host without priority is refused for it; if there is
        none, the oldest of a priority host, but only for another priority host. Otherwise the new connection is closed.
        """
        management = self._management
        if not management.accept(transport):
            transport.abort()
            return
        address = transport.get_extra_info("peername")
        peer, is_priority = peer_name(address), management.listener_context.is_priority(host_of(address))
        limit = self._parameters.max_handshakes
        while len(self._waiting) >= limit:
            oldest = next(iter(self._strangers), next(iter(self._waiting)) if is_priority else None)
            if oldest is None:
                self._refuse(peer, TlsFailure(FailureKind.CROWDED_OUT, f"all {limit} handshakes are of priority hosts"))
                transport.abort()
                return
            oldest.refuse(
                TlsFailure(FailureKind.CROWDED_OUT, f"{limit} handshakes are the limit, and it was the oldest")
            )
        self._context.name = management.listener  # with the port that it has got
        context = self._context.current()
        self._look_at_own()
        layer = TlsLayer(
            management.loop,
            context,
            server_side=True,
            timeout=self._parameters.handshake_timeout,
            established=self._agreed,
            failed=self._failed,
            gone=self._gone,
        )
        self._waiting[layer] = peer
        if not is_priority:
            self._strangers[layer] = None
        transport.set_protocol(layer)
        layer.connection_made(transport)

    def _agreed(self, layer: TlsLayer) -> asyncio.BufferedProtocol | None:
        """Check the client's certificate once its handshake is complete.

        Returns the asyncio protocol of the connection, which then asks for a connection slot; None if the client is
        refused.
        """
        tls = layer.get_extra_info("ssl_object")
        certificate = tls.getpeercert(binary_form=True)
        try:
            role, subject = self._identity(self._waiting[layer], certificate)
        except TlsFailure as failure:
            layer.refuse(failure)
            return None
        del self._waiting[layer]
        self._strangers.pop(layer, None)
        self._established += 1
        self._resumed += bool(tls.session_reused)
        self._without_role += role is None
        return ServerConnection(self._management, certified=Certified(role, subject))

    def _identity(self, peer: str, certificate: bytes | None) -> tuple[str | None, str]:
        """Return role and subject of a client's certificate. Raises `TlsFailure` if the client is refused."""
        if not certificate:
            raise TlsFailure(FailureKind.NO_CERTIFICATE, "the client sent no certificate")
        reading = role_of_certificate(certificate)
        facts = facts_of_der(certificate)
        if now() > facts.not_after:
            raise TlsFailure(FailureKind.EXPIRED, "the client's certificate has expired since the session began")
        if self._parameters.require_purpose and not facts.states_purpose:
            sentence = f"the client's certificate {facts.subject} does not say what it is for (extended key usage)"
            raise TlsFailure(FailureKind.WRONG_PURPOSE, f"{sentence}, and that is required (require_purpose)")
        if reading.role is None:
            about = f" ({reading.reason})" if reading.reason else ""
            if self._parameters.require_role:
                sentence = f"the client's certificate {facts.subject} has no role{about}, and one is required"
                raise TlsFailure(FailureKind.NO_ROLE, sentence)
            if reading.reason:
                about = f"{_host_of(peer)} {facts.subject}"
                self._say(about, "%s: the certificate %s has no role: %s", peer, facts.subject, reading.reason)
        return reading.role, facts.subject

    def _failed(self, layer: TlsLayer, failure: TlsFailure) -> None:
        """Count and log a TLS handshake that failed, was refused, or whose client disconnected."""
        self._strangers.pop(layer, None)
        self._refuse(self._waiting.pop(layer, "?"), failure)
        if layer.state is TlsState.REFUSED:
            while len(self._leaving) >= self._parameters.max_handshakes:
                oldest = next(iter(self._leaving))
                del self._leaving[oldest]
                oldest.abort()
            self._leaving[layer] = None

    def _refuse(self, peer: str, failure: TlsFailure) -> None:
        """Count and log a client that was refused before, during or after its handshake."""
        self._refused[failure.kind.value] += 1
        about = f"{_host_of(peer)} {failure.kind.value}"
        self._say(about, "%s: refused at %s: %s", peer, self._management.listener, failure)

    def _say(self, about: str, message: str, *arguments: object) -> None:
        self._management.listener_context.say(logging.WARNING, about, message, *arguments)

    def _gone(self, layer: TlsLayer) -> None:
        """Remove the entry of a refused TLS client whose connection has ended."""
        self._leaving.pop(layer, None)


def _host_of(peer: str) -> str:
    return peer.rpartition(":")[0]


class _PendingHandshake(asyncio.Protocol):
    """The asyncio protocol of an accepted connection until its TLS handshake begins in `connection_made`."""

    def __init__(self, admission: TlsAdmission) -> None:
        self._admission = admission

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Pass the accepted connection on to the TLS admission, which begins the TLS handshake."""
        # Transports of uvloop are no subclass of asyncio.Transport.
        self._admission.arrived(cast(asyncio.Transport, transport))

"""Checks of Modbus/TCP Security: connections that must not lead to an answer.

Knows what is changed in a handshake; the request behind it is a read of the probe.
"""

from typing import Final

from ..check import Accepts, Ask, BesideIt, Check, Level, TlsChange
from .words import check

_NO_ANSWER: Final = Accepts(silence=True, closed=True)
_CHANGES: Final = {
    TlsChange.PLAIN: ("tls-plain", "M1", "answers no request that comes without TLS"),
    TlsChange.TLS_1_0: ("tls-1.0", "M2", "refuses TLS 1.0"),
    TlsChange.TLS_1_1: ("tls-1.1", "M2", "refuses TLS 1.1"),
    TlsChange.SHA_1: ("tls-sha-1", "M2", "refuses suites whose message code is SHA-1"),
    TlsChange.NO_ENCRYPTION: ("tls-no-encryption", "M2", "refuses suites without encryption"),
    TlsChange.NO_CERTIFICATE: ("tls-no-certificate", "M3", "refuses a client without a certificate"),
    TlsChange.FOREIGN_CERTIFICATE: ("tls-foreign", "M3", "refuses a certificate of an authority that it does not know"),
}
"""By the change of a handshake: the name of the check, its clause, and what the device does."""


def handshake_checks(probe: bytes) -> list[Check]:
    """Return the checks of TLS; ``probe`` is a read that is answered over a right connection."""
    return [
        check(name, clause, says, BesideIt(Ask(probe, _NO_ANSWER), change), level=Level.DIAG)
        for change, (name, clause, says) in _CHANGES.items()
    ]

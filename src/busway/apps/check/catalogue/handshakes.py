"""Checks of Modbus/TCP Security: connections that must not lead to an answer, or only to exception 01.

Knows what is changed in a handshake; the request after it is a read of the probe. The user gives the certificates that
only the owner of the device's authority can make.
"""

from typing import Final

from ..check import Accepts, Ask, BesideIt, Check, Level, TlsChange
from .words import check

_NO_ANSWER: Final = Accepts(silence=True, closed=True)
_ACCEPTED: Final = {
    TlsChange.DENIED_ROLE: Accepts(exceptions=frozenset({1})),
    TlsChange.NO_ROLE: Accepts(exceptions=frozenset({1}), closed=True),
}
"""What may come back for the changes after which the device may answer."""
_CHANGES: Final = {
    TlsChange.PLAIN: ("tls-plain", "M1", "answers no request that comes without TLS"),
    TlsChange.TLS_1_0: ("tls-1.0", "M2", "refuses TLS 1.0"),
    TlsChange.TLS_1_1: ("tls-1.1", "M2", "refuses TLS 1.1"),
    TlsChange.SHA_1: ("tls-sha-1", "M2", "refuses suites whose message code is SHA-1"),
    TlsChange.NO_ENCRYPTION: ("tls-no-encryption", "M2", "refuses suites without encryption"),
    TlsChange.NO_CERTIFICATE: ("tls-no-certificate", "M3", "refuses a client without a certificate"),
    TlsChange.FOREIGN_CERTIFICATE: ("tls-foreign", "M3", "refuses a certificate of an authority that it does not know"),
    TlsChange.EXPIRED_CERTIFICATE: ("tls-expired", "M3", "refuses an expired certificate of its own authority"),
    TlsChange.REVOKED_CERTIFICATE: ("tls-revoked", "M3", "refuses a revoked certificate of its own authority"),
    TlsChange.DENIED_ROLE: ("tls-role-denied", "M6", "answers 01 to a read that the role of a client may not make"),
    TlsChange.NO_ROLE: ("tls-no-role", "M5", "lets a certificate without a role do nothing that needs one"),
}
"""By the change of a handshake: the name of the check, its clause, and what the device does."""


def handshake_checks(probe: bytes) -> list[Check]:
    """Return the checks of TLS handshakes.

    ``probe`` is the PDU of a read of the target's probe, which the device answers over a correct connection.
    """
    return [
        check(name, clause, says, BesideIt(Ask(probe, _ACCEPTED.get(change, _NO_ANSWER)), change), level=Level.DIAG)
        for change, (name, clause, says) in _CHANGES.items()
    ]

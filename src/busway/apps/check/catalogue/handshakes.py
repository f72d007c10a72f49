"""Checks of Modbus/TCP Security: connections that a device must refuse, or must answer with exception 01 only.

Each check changes one thing in a TLS handshake and then sends a read of the probe. Client certificates that only the
certificate authority of the device can issue, such as an expired one, come from the user.
"""

from typing import Final

from ..check import Accepts, Ask, BesideIt, Check, Level, TlsChange
from .shorthand import check

_NO_ANSWER: Final = Accepts(silence=True, closed=True)
_ACCEPTED: Final = {
    TlsChange.DENIED_ROLE: Accepts(exceptions=frozenset({1})),
    TlsChange.NO_ROLE: Accepts(exceptions=frozenset({1}), closed=True),
}
"""What a device may answer after those changed handshakes that it need not refuse: exception 01.

Without a role it may also close the connection. After all other changes it must close the connection or stay silent.
"""
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
"""For each changed handshake: the name of its check, the clause, and what a correct device does."""


def handshake_checks(probe: bytes) -> list[Check]:
    """Return the checks of TLS handshakes, one for each changed handshake.

    ``probe`` is the PDU of a read that the device answers over a connection with a correct handshake.
    """
    return [
        check(name, clause, says, BesideIt(Ask(probe, _ACCEPTED.get(change, _NO_ANSWER)), change), level=Level.DIAG)
        for change, (name, clause, says) in _CHANGES.items()
    ]

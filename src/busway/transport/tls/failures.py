"""Reasons why a TLS connection failed or ended: as text for an operator, and as a kind for counters.

Knows the errors of ``ssl`` and the alerts of TLS (RFC 8446 §6); knows no connection.

An alert that the peer sends concerns *our* certificate, an error that this side finds concerns the peer's; the texts
say which.
"""

import ssl
import time
from collections.abc import Mapping
from enum import Enum
from typing import Final


class FailureKind(Enum):
    """Kinds of TLS failures, for counters; the value is the name in a status.

    GONE: the peer closed the connection. CROWDED_OUT: the server gave up the handshake, because too many were in
    progress. The kinds about certificates concern the peer's certificate.
    """

    EXPIRED = "expired"
    NOT_YET_VALID = "not yet valid"
    SELF_SIGNED = "self-signed"
    UNKNOWN_AUTHORITY = "unknown authority"
    WRONG_NAME = "wrong name"
    WRONG_PURPOSE = "wrong purpose"
    REVOKED = "revoked"
    NOT_KNOWN_WHETHER_REVOKED = "not known whether revoked"
    TOO_WEAK = "too weak"
    BAD_CERTIFICATE = "bad certificate"
    NO_CERTIFICATE = "no certificate"
    WRONG_VERSION = "wrong version"
    NO_COMMON_SUITE = "no common suite"
    NOT_TLS = "not TLS"
    REFUSED_BY_PEER = "refused by the peer"
    TOO_SLOW = "too slow"
    GONE = "gone"
    CROWDED_OUT = "crowded out"
    NO_ROLE = "no role"
    TWO_ROLES = "two roles"
    OTHER = "other"


class TlsFailure(ConnectionError):
    """Error: a TLS connection failed; the text says why, and does not name the peer.

    Attributes:
        kind: the kind under which it is counted.
    """

    def __init__(self, kind: FailureKind, sentence: str) -> None:
        super().__init__(sentence)
        self.kind = kind


def failure_of(error: ssl.SSLError, *, server_side: bool) -> TlsFailure:
    """Create the `TlsFailure` for an error of ``ssl``, which becomes its cause.

    ``server_side``: True on a server, False on a client.
    """
    kind, sentence = _verdict(error, "client" if server_side else "server")
    failure = TlsFailure(kind, sentence)
    failure.__cause__ = error
    return failure


def dated(failure: TlsFailure, certificate: Mapping[str, object], now: float) -> TlsFailure:
    """Return a failure of the same kind whose text says that the server's certificate is out of date, with its date.

    If that certificate is valid at ``now``, the text says instead, without a date, that one of an authority above it is
    not. ``certificate`` is the server's, as ``getpeercert`` returns it; ``now`` is in seconds since 1970.
    """
    begins, ends = (ssl.cert_time_to_seconds(str(certificate[key])) for key in ("notBefore", "notAfter"))
    if now > ends:
        sentence = f"the server's certificate has expired on {date_of(ends)}"
    elif now < begins:
        sentence = f"the server's certificate is not valid before {date_of(begins)}; it is {date_of(now)} here"
    else:
        which = "has expired" if failure.kind is FailureKind.EXPIRED else "is not valid yet"
        sentence = f"the certificate of an authority above the server's {which}"
    return TlsFailure(failure.kind, sentence)


def date_of(moment: float) -> str:
    """Return seconds since 1970 as text: ``2027-03-01 12:00 UTC``."""
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(moment))


def _verdict(error: ssl.SSLError, peer: str) -> tuple[FailureKind, str]:
    reason = error.reason or ""
    if isinstance(error, ssl.SSLCertVerificationError):
        kind, sentence = _VERIFICATION.get(error.verify_code, (FailureKind.BAD_CERTIFICATE, ""))
        if kind is FailureKind.WRONG_NAME:
            return kind, f"the {peer}'s certificate is for another name: {error.verify_message}"
        return kind, f"the {peer}'s certificate {sentence or f'is refused: {error.verify_message}'}"
    for prefix in ("TLSV1_ALERT_", "SSLV3_ALERT_", "TLSV13_ALERT_", "TLSV1_"):
        if reason.startswith(prefix):
            alert = reason.removeprefix(prefix)
            if alert == "PROTOCOL_VERSION":
                return FailureKind.WRONG_VERSION, f"the {peer} speaks no version of TLS that is allowed here"
            words = _ALERTS.get(alert, alert.lower().replace("_", " "))
            return FailureKind.REFUSED_BY_PEER, f"the {peer} refused: {words}"
    kind, words = _REASONS.get(reason, (FailureKind.OTHER, ""))
    if not words:
        return kind, f"TLS failed: {reason.lower().replace('_', ' ') or error}"
    return kind, words.replace("PEER", peer)


_VERIFICATION: Final = {
    # X509_V_ERR_… of OpenSSL. Which certificate of a chain has expired, ssl does not tell.
    3: (
        FailureKind.NOT_KNOWN_WHETHER_REVOKED,
        "may be revoked: there is no revocation list of its authority, or of one above that (revocation_list)",
    ),
    7: (FailureKind.BAD_CERTIFICATE, "has a signature that does not fit"),
    8: (
        FailureKind.NOT_KNOWN_WHETHER_REVOKED,
        "may be revoked: the signature of a revocation list does not fit (revocation_list)",
    ),
    9: (FailureKind.NOT_YET_VALID, "is not valid yet (one of its chain; or the clock here is wrong)"),
    10: (FailureKind.EXPIRED, "has expired (one of its chain; or the clock here is wrong)"),
    11: (
        FailureKind.NOT_KNOWN_WHETHER_REVOKED,
        "may be revoked: a revocation list is not valid yet, or the clock here is wrong (revocation_list)",
    ),
    12: (
        FailureKind.NOT_KNOWN_WHETHER_REVOKED,
        "may be revoked: a revocation list has expired, and a new one is needed (revocation_list)",
    ),
    18: (FailureKind.SELF_SIGNED, "is signed by itself, and not by an authority that is known here"),
    19: (FailureKind.UNKNOWN_AUTHORITY, "is signed by an authority that is not known here"),
    20: (FailureKind.UNKNOWN_AUTHORITY, "is signed by an authority that is not known here"),
    21: (FailureKind.UNKNOWN_AUTHORITY, "is signed by an authority that is not known here"),
    23: (FailureKind.REVOKED, "is revoked"),
    24: (FailureKind.BAD_CERTIFICATE, "is signed by a certificate that may sign none"),
    26: (FailureKind.WRONG_PURPOSE, "is not meant for this purpose (extended key usage)"),
    62: (FailureKind.WRONG_NAME, ""),
    64: (FailureKind.WRONG_NAME, ""),
    66: (FailureKind.TOO_WEAK, "has a key that is too short"),
    67: (FailureKind.TOO_WEAK, "comes from an authority whose key is too short"),
    68: (FailureKind.TOO_WEAK, "is signed with a digest that is too weak"),
    79: (FailureKind.BAD_CERTIFICATE, "is signed by a certificate that may sign none"),
}

_ALERTS: Final = {
    "CERTIFICATE_REQUIRED": "it wants a certificate, and was given none",
    "CERTIFICATE_EXPIRED": "it says that our certificate has expired",
    "CERTIFICATE_REVOKED": "it says that our certificate is revoked",
    "CERTIFICATE_UNKNOWN": "it does not accept our certificate",
    "BAD_CERTIFICATE": "it says that our certificate is bad",
    "UNSUPPORTED_CERTIFICATE": "it says that our certificate is not meant for this",
    "UNKNOWN_CA": "it does not know the authority of our certificate",
    "ACCESS_DENIED": "it grants no access with our certificate",
    "HANDSHAKE_FAILURE": "there is nothing to agree on (no suite in common, or it wants a certificate)",
    "DECRYPT_ERROR": "it says that a signature of ours does not fit",
    "UNRECOGNIZED_NAME": "it does not know the name it was called by",
    "INTERNAL_ERROR": "it failed itself",
}

_NO_TLS: Final = (FailureKind.NOT_TLS, "what the PEER sends is no TLS")
_VERSION: Final = (FailureKind.WRONG_VERSION, "the PEER speaks no version of TLS that is allowed here")
_SUITE: Final = (FailureKind.NO_COMMON_SUITE, "the PEER offers no suite that is allowed here")
_CURVE: Final = (FailureKind.NO_COMMON_SUITE, "the PEER offers no curve that is allowed here (curve)")

_REASONS: Final = {
    "PEER_DID_NOT_RETURN_A_CERTIFICATE": (FailureKind.NO_CERTIFICATE, "the PEER sent no certificate"),
    "WRONG_VERSION_NUMBER": _NO_TLS,
    "HTTP_REQUEST": _NO_TLS,
    "HTTPS_PROXY_REQUEST": _NO_TLS,
    "UNKNOWN_PROTOCOL": _NO_TLS,
    "BAD_RECORD_TYPE": _NO_TLS,
    "RECORD_LAYER_FAILURE": _NO_TLS,
    "PACKET_LENGTH_TOO_LONG": _NO_TLS,
    "UNSUPPORTED_PROTOCOL": _VERSION,
    "VERSION_TOO_LOW": _VERSION,
    "VERSION_TOO_HIGH": _VERSION,
    "NO_PROTOCOLS_AVAILABLE": _VERSION,
    "NO_SHARED_CIPHER": _SUITE,
    "NO_SUITABLE_SIGNATURE_ALGORITHM": _SUITE,
    "NO_SUITABLE_KEY_SHARE": _CURVE,
    "NO_SUITABLE_GROUPS": _CURVE,
    "BAD_KEY_SHARE": _CURVE,
    "WRONG_CURVE": (
        FailureKind.BAD_CERTIFICATE,
        "the PEER's certificate has a key on a curve not allowed here (curve)",
    ),
    "WRONG_CIPHER_RETURNED": _SUITE,
    "UNEXPECTED_EOF_WHILE_READING": (FailureKind.GONE, "the PEER closed the connection"),
    "DECRYPTION_FAILED_OR_BAD_RECORD_MAC": (FailureKind.OTHER, "a record of the PEER was damaged or forged"),
}

"""Builds ``ssl`` contexts from TLS options: reads the files, and names a file that is wrong.

Knows files and OpenSSL; knows no connection, and not when files change (`renewal`).

1. TLS 1.2 and 1.3 only. The parameters name the suites of TLS 1.2 and the curve that may be used. No compression, no
   renegotiation. Security level 2 (keys of at least 2048 bits RSA or 224 bits EC, nothing signed with MD5 or SHA-1); 0
   if a suite without encryption was chosen.
2. A listener asks every client for a certificate. Sessions that can be resumed, with the client's certificate, are kept
   in the server's memory and not in tickets, because only there they can be deleted after a fatal alert.
"""

import logging
import ssl
from pathlib import Path
from typing import Final

from ...errors import ConfigError
from ...options.tls import NULL_SUITES, Curve, TlsParameters, TlsVersion, Verify

_log = logging.getLogger("busway.tls")

_VERSIONS: Final = {TlsVersion.TLS_1_2: ssl.TLSVersion.TLSv1_2, TlsVersion.TLS_1_3: ssl.TLSVersion.TLSv1_3}
_BEGIN_CERTIFICATE: Final = "-----BEGIN CERTIFICATE-----"
_ANY_CERTIFICATE: Final = "CERTIFICATE-----"
_BEGIN_REVOCATIONS: Final = "-----BEGIN X509 CRL-----"
_OPENSSL_NAME: Final = {Curve.P_256: "prime256v1"}
_SUFFIXES: Final = (".pem", ".crt", ".cer", ".ca")
"""In a directory of authorities, files with these endings of their names are read."""
_NO_CHECK_TIME: Final = 0x20_0000
"""X509_V_FLAG_NO_CHECK_TIME of OpenSSL, which ``ssl`` has no name for."""


def server_context(parameters: TlsParameters) -> ssl.SSLContext:
    """Build the ``ssl`` context of a listener; every client must present a valid certificate.

    Raises:
        ConfigError: the option for the certificate or the authority is missing, or a file cannot be used; the error
            names the option, and the file if there is one.
    """
    parameters.check_server()
    context = _context(ssl.PROTOCOL_TLS_SERVER, parameters)
    context.verify_mode = ssl.CERT_REQUIRED
    context.options |= ssl.OP_NO_TICKET | ssl.OP_CIPHER_SERVER_PREFERENCE
    return context


def web_context(parameters: TlsParameters) -> ssl.SSLContext:
    """Build the ``ssl`` context of a web page for browsers, which need not present a client certificate.

    If ``authority`` is set, they are asked for one, and one that they present must be valid.

    Raises:
        ConfigError: the option for the certificate is missing, or a file cannot be used; the error names the option,
            and the file if there is one.
    """
    if parameters.certificate is None:
        raise ConfigError("a page with TLS needs a certificate", key="certificate")
    context = _context(ssl.PROTOCOL_TLS_SERVER, parameters)
    context.verify_mode = ssl.CERT_NONE if parameters.authority is None else ssl.CERT_OPTIONAL
    context.options |= ssl.OP_NO_TICKET | ssl.OP_CIPHER_SERVER_PREFERENCE
    context.set_alpn_protocols(["http/1.1"])
    return context


def client_context(parameters: TlsParameters) -> ssl.SSLContext:
    """Build the ``ssl`` context of a client; the server is not verified if ``verify`` is off.

    Raises:
        ConfigError: the option for the authority is missing, or a file cannot be used; the error names the option, and
            the file if there is one.
    """
    parameters.check_client()
    context = _context(ssl.PROTOCOL_TLS_CLIENT, parameters)
    if parameters.verify is Verify.OFF_INSECURE:
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    return context


def timeless_context(parameters: TlsParameters) -> ssl.SSLContext:
    """Return a client's context that accepts certificates out of date; only used to find out when one expired.

    Arguments and errors are those of `client_context`.
    """
    context = client_context(parameters)
    context.verify_flags |= ssl.VerifyFlags(_NO_CHECK_TIME)
    return context


def _context(protocol: int, parameters: TlsParameters) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.minimum_version = _VERSIONS[parameters.minimum_version]
    context.maximum_version = _VERSIONS[parameters.maximum_version]
    context.options |= ssl.OP_NO_COMPRESSION | ssl.OP_NO_RENEGOTIATION
    unencrypted = [name for name in parameters.suites if name in NULL_SUITES]
    # OpenSSL has suites without encryption at its lowest level only.
    context.set_ciphers(":".join([*parameters.suites, f"@SECLEVEL={0 if unencrypted else 2}"]))
    if unencrypted:
        _log.warning("%s: anyone on the way can read what such a connection carries", ", ".join(unencrypted))
    if parameters.curve is not Curve.ANY:
        # Of both sides and, by OpenSSL 3, for TLS 1.3 too: it sets the list of groups to this one.
        context.set_ecdh_curve(_OPENSSL_NAME[parameters.curve])
    if parameters.certificate is not None:
        _load_own(context, parameters, parameters.certificate)
    if parameters.authority is not None:
        _load_authority(context, parameters.authority)
    if parameters.revocation_list is not None:
        _load_revocations(context, parameters.revocation_list)
    return context


def _load_own(context: ssl.SSLContext, parameters: TlsParameters, certificate: str) -> None:
    key = parameters.key or certificate
    if _BEGIN_CERTIFICATE not in _text(certificate, "certificate"):
        raise ConfigError("there is no certificate in it (a PEM file is needed)", file=certificate, key="certificate")
    if "PRIVATE KEY-----" not in _text(key, "key"):
        raise ConfigError("there is no private key in it (a PEM file is needed)", file=key, key="key")
    password = _Password(parameters.password_file)
    try:
        context.load_cert_chain(certificate, key, password)
    except ssl.SSLError as error:
        if error.reason in ("KEY_VALUES_MISMATCH", "KEY_TYPE_MISMATCH"):
            raise ConfigError(
                f"the key does not belong to the certificate {certificate}", file=key, key="key"
            ) from error
        if password.was_asked:
            where = parameters.password_file
            raise ConfigError(
                f"the password in {where} does not open the key", file=key, key="password_file"
            ) from error
        if error.reason in ("EE_KEY_TOO_SMALL", "CA_MD_TOO_WEAK", "CA_KEY_TOO_SMALL"):
            sentence = "the certificate is too weak (a short key, or signed with MD5 or SHA-1)"
            raise ConfigError(sentence, file=certificate, key="certificate") from error
        reason = (error.reason or str(error)).lower().replace("_", " ")
        raise ConfigError(
            f"certificate and key cannot be used: {reason}", file=certificate, key="certificate"
        ) from error
    except _NoPasswordError:
        raise ConfigError(
            "the key is encrypted: name the file with its password", file=key, key="password_file"
        ) from None


class _NoPasswordError(Exception):
    """Raised if an encrypted key has no password; otherwise OpenSSL would ask at the terminal."""


class _Password:
    """Gives OpenSSL the password of an encrypted private key when OpenSSL asks for it: the first line of a file."""

    def __init__(self, file: str | None) -> None:
        self._file = file
        self.was_asked = False

    def __call__(self) -> str:
        if self._file is None:
            raise _NoPasswordError
        self.was_asked = True
        return _text(self._file, "password_file").partition("\n")[0].rstrip("\r")


def _load_authority(context: ssl.SSLContext, name: str) -> None:
    for file in authority_files(name):
        text = _text(file, "authority")
        if _BEGIN_CERTIFICATE not in text:
            raise ConfigError("there is no certificate in it (a PEM file is needed)", file=file, key="authority")
        try:
            context.load_verify_locations(cadata=text)
        except ssl.SSLError as error:
            reason = (error.reason or str(error)).lower().replace("_", " ")
            raise ConfigError(f"the certificates cannot be read: {reason}", file=file, key="authority") from error


def _load_revocations(context: ssl.SSLContext, name: str) -> None:
    text = _text(name, "revocation_list")
    if _BEGIN_REVOCATIONS not in text:
        raise ConfigError("there is no revocation list in it (a PEM file is needed)", file=name, key="revocation_list")
    if _ANY_CERTIFICATE in text:  # OpenSSL would take it for one of an authority that is trusted
        raise ConfigError(
            "there is a certificate in it; it holds revocation lists alone", file=name, key="revocation_list"
        )
    try:
        context.load_verify_locations(cafile=name)
    except (ssl.SSLError, OSError) as error:
        reason = (getattr(error, "reason", None) or str(error)).lower().replace("_", " ")
        raise ConfigError(f"the revocation lists cannot be read: {reason}", file=name, key="revocation_list") from error
    context.verify_flags |= ssl.VERIFY_CRL_CHECK_CHAIN


def authority_files(name: str) -> list[str]:
    """Return the files of the option ``authority``: the file itself, or those of a directory that are certificates.

    Raises:
        ConfigError: the directory cannot be read, or has no such file.
    """
    path = Path(name)
    if not path.is_dir():
        return [name]
    try:
        files = sorted(str(one) for one in path.iterdir() if one.suffix.lower() in _SUFFIXES and one.is_file())
    except OSError as error:
        raise ConfigError(f"cannot be read: {_system_words(error)}", file=name, key="authority") from error
    if not files:
        raise ConfigError(
            f"there is no file {', '.join(f'*{one}' for one in _SUFFIXES)} in it", file=name, key="authority"
        )
    return files


def _text(name: str, key: str) -> str:
    try:
        return Path(name).read_text(encoding="ascii", errors="replace")
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot be read: {_system_words(error)}", file=name, key=key) from error


def _system_words(error: OSError | ValueError) -> str:
    words = getattr(error, "strerror", None) or str(error)
    return f"{words[:1].lower()}{words[1:]}"

"""Checks of a configuration before it runs: rules that can never match, exposed listeners, files that cannot be used.

Knows which parts of a configuration have to fit together; opens files, and no connection.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from ..access.rules import Rule
from ..access.unreached_rules import unreached_rules
from ..codes import DEFAULT_TCP_PORT
from ..errors import ConfigError
from ..options.endpoints import EVERY_ADDRESS, Endpoint, parse_endpoint
from ..options.tls import TlsParameters
from ..server.listener import Listener
from ..values.counts import counted
from .certificates import try_certificates
from .files.key_lines import KeyPath
from .files.system import SystemFile
from .paths import TLS_FILES, within
from .report import ConfigurationReport, nearest

MOST_UNREACHED: Final = 20
"""Most rules that can never decide, and get a warning each."""


def check_roles(file: SystemFile, report: ConfigurationReport) -> None:
    """Add a warning to the report for each access rule with ``roles`` if no listener uses TLS.

    Only the certificate of a client gives it a role, so such a rule never matches.
    """
    if file.policy is None or any(parse_endpoint(url).carrier == "tls" for _, url in file.places()):
        return
    for index, rule in enumerate(file.policy.rule):
        if rule.roles is not None:
            report.warn(("policy", "rule", index, "roles"), "no client can have a role: there is no tls:// listener")


def check_listener_names(file: SystemFile, report: ConfigurationReport) -> None:
    """Add a warning to the report for each listener that an access rule names and the file does not have.

    Adds no warning if the file listens nowhere at all, or has no policy. Returns nothing.
    """
    known = [parse_endpoint(url) for _, url in file.places()]
    if file.policy is None or not known:
        return
    for index, rule in enumerate(file.policy.rule):
        for place, wanted in enumerate(rule.listeners or ()):
            if not any(_may_be_named(one, wanted) for one in known):
                sentence = f"there is no listener {wanted}, but {', '.join(one.url for one in known)}"
                report.warn(("policy", "rule", index, "listeners", place), sentence)


def check_unreached_rules(rules: Sequence[Rule], report: ConfigurationReport) -> None:
    """Add a warning to the report for each rule of ``[policy]`` that can never decide.

    After `MOST_UNREACHED` of them, one warning has the number of the others.
    """
    unreached = list(unreached_rules(rules))
    for later, earlier in unreached[:MOST_UNREACHED]:
        sentence = f"{rules[later].name!r} never decides: {rules[earlier].name!r} before it takes all its requests"
        report.warn(("policy", "rule", later), sentence)
    if len(unreached) > MOST_UNREACHED:
        others = counted(len(unreached) - MOST_UNREACHED, "rule")
        report.warn(("policy", "rule", unreached[MOST_UNREACHED][0]), f"{others} from here on never decide")


def _may_be_named(listener: Endpoint, wanted: str) -> bool:
    """Return True if the text ``wanted`` of an access rule can mean a listener, as configured or as it will be bound.

    A scheme alone, such as ``tcp://``, means all listeners of the scheme. Otherwise scheme, port and host must fit: the
    port is that of the listener, or with ``tcp://`` also 502, where the server can add a listener (`standard_port`). A
    listener with a host name fits any host, because names are not resolved. A listener on all addresses fits only the
    hosts that mean all: ``0.0.0.0``, ``::`` and none. A serial line fits its own URL only. True also for a text that is
    no URL: another check reports that.
    """
    if wanted.endswith("://"):
        return listener.scheme == wanted.lower()[:-3]
    try:
        meant = parse_endpoint(wanted)
    except ConfigError:
        return True  # that is a problem of the rule
    if meant.scheme != listener.scheme:
        return False
    if listener.carrier == "serial":
        return meant.url == listener.url
    ports = {listener.port} | ({DEFAULT_TCP_PORT} if listener.scheme == "tcp" else set())
    is_name = not listener.host.replace(".", "").isdecimal() and ":" not in listener.host
    hosts = EVERY_ADDRESS if listener.host in EVERY_ADDRESS else {listener.host}
    return meant.port in ports and (meant.host in hosts or (is_name and bool(listener.host)))


def check_exposure(file: SystemFile, report: ConfigurationReport) -> None:
    """Add a warning to the report for each listener on all addresses of this host.

    It is for files that are only checked: a server that starts logs the same with the port that it has bound
    (`busway.server.exposure`).
    """
    for place, url in file.places():
        endpoint = parse_endpoint(url)
        if endpoint.host in EVERY_ADDRESS and endpoint.carrier != "serial":
            report.warn(place, f"{endpoint.url} listens on every interface of this host")


def check_files(file: SystemFile, name: str, listeners: Sequence[Listener], report: ConfigurationReport) -> None:
    """Open the files that a configuration names, and add a problem to the report for each that cannot be used.

    Those are the files of certificates and keys that keys of the file name, and the folder of the audit log, which must
    be writable. If none of them has a problem, the certificates of each listener are loaded too, also those that the
    options of its URL name.

    Args:
        file: the configuration.
        name: path of the configuration file; relative paths start from its folder.
        listeners: its listeners, in the order of ``file.places()``.
        report: collects problems.
    """
    wrong = len(report.problems)
    for place, path in _named_files(file):
        _readable(place, within(name, path), report)
    if file.audit_parameters is not None:
        folder = Path(within(name, file.audit_parameters.path)).parent
        if not folder.is_dir() or not os.access(folder, os.W_OK):
            report.refuse(("audit", "path"), f"nothing can be written in {folder}")
    if len(report.problems) > wrong:
        return
    for (place, _), listener in zip(file.places(), listeners, strict=True):
        _usable(listener, _Keys(file, place), report)


class _Keys:
    """Callable that takes the name of a TLS option of a listener, and returns the path in the file where it is set.

    That is in the listener's own section or in ``[security]``; the path of the listener if it is set in neither, and
    for None.

    Args:
        file: the configuration.
        place: path of the listener's URL in the file.
    """

    def __init__(self, file: SystemFile, place: KeyPath) -> None:
        self._own = file.listener[int(place[1])].options_of(TlsParameters) if place[0] == "listener" else {}
        self._general = file.security.options()
        self._at = place[:2]

    def __call__(self, key: str | None) -> KeyPath:
        return nearest(key, self._own, self._at, self._general, ("security",))


def _named_files(file: SystemFile) -> Iterator[tuple[KeyPath, str]]:
    sections: list[tuple[KeyPath, object]] = [(("security",), file.security), (("client",), file.client)]
    sections += [(("listener", index), each) for index, each in enumerate(file.listener)]
    sections += [(("link", index), each) for index, each in enumerate(file.link)]
    for place, section in sections:
        for key in TLS_FILES:
            path = getattr(section, key)
            if path is not None:
                yield (*place, key), path


def _readable(place: KeyPath, path: str, report: ConfigurationReport) -> None:
    """Add a problem to the report if a file cannot be read; a folder of authorities is accepted."""
    if Path(path).is_dir() and place[-1] == "authority":
        return
    try:
        with open(path, "rb"):
            pass
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        report.refuse(place, f"{path} cannot be read: {reason[:1].lower()}{reason[1:]}")


def _usable(listener: Listener, place: Callable[[str | None], KeyPath], report: ConfigurationReport) -> None:
    """Add a problem to the report if the certificate and key of a listener do not fit together or cannot be loaded."""
    try:
        try_certificates(listener)
    except ConfigError as error:
        report.refuse(place(error.key), f"{error.file}: {error.message}" if error.file else error.message)

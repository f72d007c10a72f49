"""The links that a configuration names: endpoint and options, checked as `busway.open` would.

Knows which source of an option has precedence; the client knows what options mean.

1. For each option the first source that sets it counts: the link's section or its URL, ``[client]``, for certificates
   ``[security]``, the preset, and the defaults of the program that uses the links. Section and URL never give an option
   with different values: `busway.config.files.options` refuses that.
2. An option of ``[client]``, of the program or of ``[security]`` applies only to links whose scheme has it; other links
   ignore it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ..client.settings import LinkSettings, link_settings, options_of, with_defaults
from ..options.accepted_options import LINKS, aliases, options_for
from ..options.declaration import declared
from ..options.endpoints import parse_endpoint
from ..options.tls import TlsParameters
from .files.key_lines import KeyPath
from .files.system import LinkSection, SystemFile
from .paths import TLS_FILES
from .report import ConfigurationReport, nearest


@dataclass(frozen=True, slots=True)
class NamedLink:
    """A link that a configuration declares: its name, endpoint and options.

    Attributes:
        name: the name that the configuration gives it.
        url: the endpoint, with the options in the URL.
        options: the options from the file's sections and the program's defaults, by name, as `busway.open` and
            `busway.connect` take them, with paths of certificates and keys joined to the file's folder, also those in
            ``url``. Other options that are in ``url`` are left out if the link's own section does not give them too.
        settings: endpoint and all options, checked.
    """

    name: str
    url: str
    options: Mapping[str, Any]  # of several types
    settings: LinkSettings


def named_links(
    file: SystemFile,
    root: Callable[[Mapping[str, Any]], dict[str, Any]],
    report: ConfigurationReport,
    defaults: Mapping[str, Any],
) -> dict[str, NamedLink]:
    """Return the links of a file by name; a link with a problem is left out, and the problem added to the report.

    Args:
        file: the checked contents of the file.
        root: takes options by name, and returns them with relative paths joined to the file's folder.
        report: collects problems.
        defaults: options for which the program that uses the links has other defaults than a client.
    """
    offered = options_for("client", TlsParameters)
    security = {name: value for name, value in file.security.options().items() if name in offered}
    general = file.client.options()
    links: dict[str, NamedLink] = {}
    for index, section in enumerate(file.link):
        made = _named_link(section, general, security, defaults, root, ("link", index), report)
        if made is not None:
            links[made.name] = made
    return links


def _named_link(
    section: LinkSection,
    general: Mapping[str, Any],
    security: Mapping[str, Any],
    defaults: Mapping[str, Any],
    root: Callable[[Mapping[str, Any]], dict[str, Any]],
    at: KeyPath,
    report: ConfigurationReport,
) -> NamedLink | None:
    """Return the link that a section declares; None if it is invalid, with a problem added to the report.

    Args:
        section: the link's section in the file.
        general: options of ``[client]``, for all links.
        security: certificates of ``[security]`` for all links.
        defaults: the program's defaults.
        root: takes options by name, and returns them with relative paths joined to the file's folder.
        at: the path of the section in the file.
        report: collects problems.
    """
    endpoint = parse_endpoint(section.url)
    offered = options_of(endpoint)
    own = section.options()
    in_url = {aliases().get(name, name) for name in endpoint.options}
    behind = {name: value for name, value in {**security, **general}.items() if name in offered and name not in in_url}
    paths = {name: path for name, path in endpoint.options.items() if name in TLS_FILES}
    options = root(with_defaults(endpoint, behind | paths | own, defaults))

    def place(key: str | None) -> KeyPath:
        if key in in_url and key not in own:
            return (*at, "url")
        if key in security and key not in general and key not in own:
            return ("security", str(key))
        return nearest(key, own, at, general, ("client",))

    def make() -> LinkSettings:
        made = link_settings(endpoint, options)
        if made.security is not None:
            made.security.check_client()
        return made

    known = {name: option for kind in LINKS for name, option in declared(kind).items() if name in offered}
    report.check_numbers(known, options, place)
    settings = report.make(make, place)
    return None if settings is None else NamedLink(section.name, section.url, options, settings)

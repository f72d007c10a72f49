"""The rights of each role at the NATS servers of a fleet, as data: what the generated configuration permits.

Pure: knows subjects, streams and roles; knows no server. The table of rights in the documentation is made from it.

1. What is not named is refused. No role may delete, purge or change a stream, or delete its messages.
2. Only the operator makes streams (`busway fleet apply`), only under the names of its zone.
3. All roles read the table of the zone. Each changes only the keys that are its own.
4. A collector may answer the sender of a command, and may publish to no other inbox (``allow_responses``).
"""

from dataclasses import dataclass
from typing import Final

_TABLE: Final = "KV_busway-{zone}"
_KEYS: Final = "KV_busway-{zone}-commands"
_SAMPLES: Final = "busway-samples-{zone}"
_AUDIT: Final = "busway-audit-{zone}"
STREAMS: Final = (_TABLE, _KEYS, _SAMPLES, _AUDIT)
"""All streams of a zone."""
ANSWERS: Final = "_INBOX.>"


@dataclass(frozen=True, slots=True)
class Right:
    """One thing that a role may do at the NATS servers, and the subjects that a client needs for it.

    Attributes:
        does: what the role may do, in words, for the table of the documentation.
        publish, subscribe: the subjects to publish and to subscribe to, with ``{zone}`` for the name of the zone.
        answers: whether the role may answer requests that it receives.
    """

    does: str
    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    answers: bool = False


@dataclass(frozen=True, slots=True)
class Permissions:
    """The subjects of NATS that a user may publish and subscribe to.

    Attributes:
        publish, subscribe: the subjects.
        answers: whether the user may answer requests that it receives.
    """

    publish: tuple[str, ...]
    subscribe: tuple[str, ...]
    answers: bool


def _looked_up(stream: str) -> str:
    return f"$JS.API.STREAM.INFO.{stream}"


def _followed(stream: str) -> tuple[str, ...]:
    return (_looked_up(stream), f"$JS.API.CONSUMER.CREATE.{stream}", f"$JS.API.CONSUMER.CREATE.{stream}.>")


_READS: Final = Right("reads the table: leases, collectors, configuration, cursors", _followed(_TABLE), (ANSWERS,))
RIGHTS: Final[dict[str, tuple[Right, ...]]] = {
    "collector": (
        _READS,
        Right(
            "takes, renews and releases leases, and says that it lives",
            ("$KV.busway-{zone}.lease.>", "$KV.busway-{zone}.member.>", "$KV.busway-{zone}.zone"),
        ),
        Right("publishes samples", (_looked_up(_SAMPLES), "busway.{zone}.samples.>")),
        Right("publishes live values", ("busway.{zone}.live.*",)),
        Right("takes commands and answers them", (), ("busway.{zone}.command.*",), answers=True),
        Right("passes on commands by MQTT and NATS to the owner of the link", ("busway.{zone}.command.*",)),
        Right("remembers keys of commands", (*_followed(_KEYS), "$KV.busway-{zone}-commands.keys.*")),
        Right("adds lines to the audit", (_looked_up(_AUDIT), "busway.{zone}.audit")),
    ),
    "sink": (
        _READS,
        Right(
            "takes samples from the stream",
            (
                _looked_up(_SAMPLES),
                f"$JS.API.CONSUMER.INFO.{_SAMPLES}.*",
                f"$JS.API.CONSUMER.DURABLE.CREATE.{_SAMPLES}.*",
                f"$JS.API.CONSUMER.CREATE.{_SAMPLES}.*.>",
                f"$JS.API.CONSUMER.MSG.NEXT.{_SAMPLES}.*",
                f"$JS.ACK.{_SAMPLES}.>",
            ),
        ),
        Right("publishes its cursor", ("$KV.busway-{zone}.cursor.*",)),
    ),
    "operator": (
        _READS,
        Right("applies configurations, drains collectors", ("$KV.busway-{zone}.control.>",)),
        Right("sets how long leases hold, while no collector runs", ("$KV.busway-{zone}.zone",)),
        Right("raises the generation (restore)", ("$KV.busway-{zone}.generation",)),
        Right("makes the streams of the zone", tuple(f"$JS.API.STREAM.CREATE.{stream}" for stream in STREAMS)),
        Right(
            "sees how far streams and sinks are",
            (*map(_looked_up, (_KEYS, _SAMPLES)), f"$JS.API.STREAM.MSG.GET.{_SAMPLES}"),
        ),
        Right("sends commands", ("busway.{zone}.command.*",)),
        Right("reads live values and the audit", _followed(_AUDIT), ("busway.{zone}.live.*",)),
    ),
}
"""What each role may do in its zone, by name of the role."""
STATUS: Final = Permissions(
    ("$SYS.REQ.SERVER.PING", "$SYS.REQ.SERVER.PING.*", "$SYS.REQ.SERVER.*.VARZ", "$SYS.REQ.SERVER.*.JSZ"),
    (ANSWERS,),
    answers=False,
)
"""The permissions of the user of the system account, who may only ask for the state of the servers."""


def permissions(role: str, zone: str, *, is_site: bool = False) -> Permissions:
    """Return the subjects that a role may publish and subscribe to in a zone.

    Args:
        role: ``collector``, ``sink`` or ``operator``: a key of `RIGHTS`.
        zone: name of the zone.
        is_site: True for the file of the centre if the zone is that of an edge site: then the result also has the
            subjects that reach the JetStream domain of the site.
    """
    rights = RIGHTS[role]
    publish = dict.fromkeys(subject.replace("{zone}", zone) for each in rights for subject in each.publish)
    if is_site:
        publish |= dict.fromkeys(in_domain(subject, zone) for subject in publish)
    subscribe = dict.fromkeys(subject.replace("{zone}", zone) for each in rights for subject in each.subscribe)
    return Permissions(tuple(publish), tuple(subscribe), any(each.answers for each in rights))


def in_domain(subject: str, domain: str) -> str:
    """Return the subject that reaches a subject of JetStream's API, or a key of a table, in another domain.

    Any other subject is returned as it is: it is the same in all domains.

    Args:
        subject: the subject within its domain.
        domain: name of the JetStream domain of an edge site.
    """
    if subject.startswith("$JS.API."):
        return f"$JS.{domain}.API.{subject.removeprefix('$JS.API.')}"
    return f"$JS.{domain}.API.{subject}" if subject.startswith("$KV.") else subject


def rights_table(zone: str) -> str:
    """Return the rights of all roles as a table in Markdown, for the documentation.

    Args:
        zone: name of a zone, to be shown in the subjects.
    """
    lines = ["| role | may | publishes | subscribes |", "| --- | --- | --- | --- |"]
    for role, rights in RIGHTS.items():
        for right in rights:
            columns = (role, right.does, _listed(right.publish, zone), _listed(right.subscribe, zone))
            lines.append("| " + " | ".join(columns) + " |")
    publish, subscribe = (_listed(each, zone) for each in (STATUS.publish, STATUS.subscribe))
    lines.append(f"| status (system account) | asks how the servers are | {publish} | {subscribe} |")
    return "\n".join(lines) + "\n"


def _listed(subjects: tuple[str, ...], zone: str) -> str:
    return ", ".join(f"`{each.replace('{zone}', zone)}`" for each in subjects)

"""The coordinator on NATS JetStream: one key-value bucket for each zone.

Knows streams and subjects; the protocol is nats-py's (``busway[nats]``). Works with nats-server 2.9.

1. A change is a publication that names the last sequence of its subject: the server compares and sets. The key-value
   functions of the client are not used, because their ``create`` decides by a read that a follower may answer.
2. A watch is a consumer without acknowledgement whose messages must follow each other without a gap. After a gap, or
   `QUIET` seconds without a message or heartbeat, it begins anew.
3. The copies of a table on the servers of a cluster can differ in nats-server 2.9 after one of them was killed: one
   lags for good, or has other revisions. The leader of the cluster decides about changes; a watch can be served by any
   server. So each watch is compared with the answers of the leader: a change that was confirmed, or the revision in a
   refusal, must show within `LATE` seconds, and with that revision. Otherwise the watch begins anew at the leader, and
   that is logged.
4. The server's count of entries that a watch has not shown yet can stay above zero for good. So a watch also counts as
   complete when it has shown as many keys as there were at its begin, or when `QUIET` seconds have passed.
5. A connection that answers no ping is given up after about five seconds; the next server of the URL is tried.
6. If the server ends a connection, for any reason, connecting is tried again without end: credentials that were revoked
   may be granted again. Meanwhile the error of every change has the last error that the server reported.
"""

import asyncio
import contextlib
import logging
import re
import time
from collections.abc import AsyncGenerator, Callable, Coroutine
from functools import cache
from importlib import import_module
from typing import Any, Final, TypeVar

from ....errors import ConfigError
from ....extras import require
from ....safe_files import read_safely
from ...collector.sinks.hidden_secrets import HiddenSecrets
from ...collector.sinks.nats_connection import nats_client_kind
from ...collector.sinks.options import tls_context
from ..coordinator import (
    LONGEST_VALUE,
    SNAPSHOT_BEGINS,
    SNAPSHOT_ENDS,
    CoordinatorDown,
    Entry,
    OutcomeUnknown,
    RevisionConflict,
)
from ..server_rights import in_domain
from ..shards import checked_name
from .opening import CoordinatorOptions, hidden_secrets
from .outages import OutageLog

OLDEST: Final = (2, 9, 0)
HEARTBEAT: Final = 1.0
QUIET: Final = 4.0
LATE: Final = 3.0
"""Seconds within which a watch must show a change that the leader has confirmed."""
MOST_TRIES: Final = 12
"""Most consumers that are created to get one on the leader: the cluster chooses the server of each by chance."""
LOOK_EVERY: Final = 0.05
NOT_YET: Final = (10004, 10005, 10008, 10009, 10023, 10118)
"""Error codes of JetStream that go away by themselves: too few servers of a cluster are up, or there is no leader."""
_WRONG_SEQUENCE: Final = (10071, 10164)
_T = TypeVar("_T")
_MOST_WAITING: Final = 65_536
_MOST_CREDENTIALS: Final = 65_536
_SEQUENCE: Final = re.compile(r"wrong last sequence: (\d+)")
_log = logging.getLogger("busway.fleet")


async def open_nats(url: str, zone: str, options: CoordinatorOptions) -> "NatsCoordinator":
    """Connect to the table that a zone's collectors share in NATS, a key-value bucket; it is created if missing.

    Args:
        url: ``nats://HOST:PORT`` or ``tls://HOST:PORT``, with further hosts after commas.
        zone: name of the zone.
        options: credentials, certificates, replicas and the timeout of the connection.

    Raises:
        ConfigError: the name of the zone is invalid, the server is too old or refuses the credentials or rights, or
            the bucket has too few replicas.
        CoordinatorDown: the server cannot be used now.
        MissingExtra: the package nats-py (or nkeys, for a credentials file) is not installed.
    """
    require("nats", "a coordinator on NATS")
    bucket = f"busway-{checked_name(zone, 'zone')}"
    client = await connect_nats(url, options)
    try:
        info = await find_bucket(client, bucket, options)
    except BaseException:
        await client.close()
        raise
    table = NatsCoordinator(client, bucket, options.answer, options.domain)
    table.replicas, table.is_clustered = int(info.config.num_replicas or 1), info.cluster is not None
    return table


async def connect_nats(url: str, options: CoordinatorOptions) -> Any:  # nats-py's own
    """Return a client of nats-py that is connected to a server of a URL, and connects again after a lost connection.

    Args:
        url: ``nats://HOST:PORT`` or ``tls://HOST:PORT``, with further hosts after commas.
        options: credentials, certificates and the timeout of the connection.

    Raises:
        ConfigError: the server is too old, or refuses the credentials, or a file for them or for TLS cannot be used.
        CoordinatorDown: no server can be reached.
        MissingExtra: the package nkeys is not installed, and a credentials file needs it.
    """
    nats = import_module("nats")
    scheme, _, hosts = url.partition("://")
    encrypts = scheme == "tls" or options.ca or options.certificate
    given = {
        "user": options.user,
        "password": options.password,
        "token": options.token,
        **_credentials(options.credentials),
        "tls": tls_context(options.ca, options.certificate, options.key) if encrypts else None,
    }
    secrets = hidden_secrets(url, options)
    client, shown = _client_kind()(secrets), secrets.hide(url)
    client.must_encrypt = given["tls"] is not None
    try:
        async with asyncio.timeout(4 * options.answer):
            await client.connect(
                servers=[f"{scheme}://{each.strip()}" for each in hosts.split(",")],
                error_cb=client.note_cause,
                reconnected_cb=client.note_new_connection,
                connect_timeout=options.answer,
                allow_reconnect=True,
                max_reconnect_attempts=-1,
                reconnect_time_wait=0.25,
                ping_interval=2,
                max_outstanding_pings=2,
                **{name: value for name, value in given.items() if value is not None},
            )
    except ConfigError:
        await _close(client)
        raise
    except (nats.errors.Error, OSError, TimeoutError) as error:
        await _close(client)
        raise CoordinatorDown(
            f"{shown} cannot be reached: {client.cause or client.words(error)}", endpoint=shown
        ) from error
    client.was_connected = True
    server = client.connected_server_version
    version = (server.major, server.minor, server.patch)
    if version < OLDEST:
        await client.close()
        raise ConfigError(
            f"{shown} runs nats-server {'.'.join(map(str, version))}; 2.9 or newer is needed", key="coordinator"
        )
    return client


async def _close(client: Any) -> None:
    nats = import_module("nats")
    # It may be gone already; a transport of TLS that has ended says so by AttributeError.
    with contextlib.suppress(nats.errors.Error, OSError, TimeoutError, AttributeError):
        await client.close()


def _is_refusal(cause: str) -> bool:
    """Whether a server's error text says that the credentials are refused; a timeout of the login is no refusal."""
    return "auth" in cause.lower() and "timeout" not in cause.lower()


@cache
def _client_kind() -> Any:
    """Return a subclass of nats-py's client that never gives up a connection that was up (rule 6).

    The client of nats-py itself gives up if a server ends a connection with an error. The subclass also keeps the last
    error of the server as the text ``cause``, with secrets hidden. Its ``again`` is an event that is set when the
    present connection is replaced by a new one; the new connection has another event.
    """
    nats = import_module("nats")

    class Client(nats_client_kind()):  # type: ignore[misc] # Any: the package is loaded when it is used
        def __init__(self, secrets: HiddenSecrets) -> None:
            super().__init__()
            self.cause = ""
            self.again = asyncio.Event()
            self.was_connected = False
            self._secrets = secrets

        def words(self, error: object) -> str:
            return self._secrets.hide(error) or type(error).__name__

        async def note_cause(self, error: Exception) -> None:
            self.cause = self.words(error)

        async def note_new_connection(self) -> None:
            self.cause = ""
            self.again.set()
            self.again = asyncio.Event()

        async def _process_connect_init(self) -> None:
            try:
                self._read_seed()
                await super()._process_connect_init()
            except BaseException as error:
                if self._transport is not None:
                    self._transport.close()  # else each refused try would leave its socket open
                if _is_refusal(str(error)) and not self.was_connected:
                    refused = f"the server refuses the credentials: {self.words(error)}"
                    raise ConfigError(refused, key="coordinator") from error
                if isinstance(error, Exception) and not isinstance(error, nats.errors.Error | OSError):
                    # Any other would end trying for good: that of a seed that is being written, or of a TLS transport
                    # that has ended meanwhile (AttributeError).
                    if isinstance(error, ConfigError) and not self.was_connected:
                        raise
                    raise nats.errors.Error(self.words(error)) from error
                raise

        def _read_seed(self) -> None:
            """Read the seed of the key pair from its file again: an operator may have replaced a refused one."""
            if self._nkeys_seed is not None:
                _credentials(self._nkeys_seed)
                self._setup_nkeys_connect()

        async def _process_err(self, message: str) -> None:
            error = nats.errors.Error(f"nats: {message}")
            await self.note_cause(error)
            if "permissions" not in message.lower():  # those are of one subject, and the connection stays
                await self._process_op_err(error)

    return Client


def _credentials(path: str | None) -> dict[str, str]:
    """Return the argument of nats-py's ``connect`` for a file with credentials or with the seed of a key pair.

    Args:
        path: path of the file; None for no file: then the result is empty.

    Raises:
        ConfigError: the file cannot be read, or holds an invalid seed.
        MissingExtra: the package nkeys is not installed.
    """
    if path is None:
        return {}
    require("nkeys", "a credentials file of NATS")
    text = read_safely(path, most=_MOST_CREDENTIALS).strip()
    if not text.startswith(b"SU"):
        return {"user_credentials": path}
    nkeys = import_module("nkeys")
    try:
        nkeys.from_seed(bytearray(text)).wipe()
    except (nkeys.NkeysError, ValueError, TypeError) as error:
        raise ConfigError("holds no seed of a user", file=path) from error
    return {"nkeys_seed": path}


def refused_subject(client: Any, subject: str) -> str:
    """Return the server's last error if it says that the credentials do not permit a subject; empty otherwise."""
    cause = str(client.cause)
    return cause if "permissions" in cause.lower() and f'"{subject.lower()}"' in cause.lower() else ""


async def asked(client: Any, subject: str, answer: Coroutine[Any, Any, _T]) -> _T:
    """Wait for the answer to a request, and return it; stop waiting at once if the server refuses the subject.

    First the last error of the server is forgotten (``client.cause`` becomes empty).

    Args:
        client: client of `connect_nats`.
        subject: subject of the request.
        answer: the coroutine of nats-py that sends the request; its own errors are raised too.

    Raises:
        TimeoutError: the server refuses the subject (`refused_subject`), or no answer came in the time that the
            coroutine waits.
    """
    client.cause = ""
    task = asyncio.ensure_future(answer)
    try:
        while not task.done():
            await asyncio.wait([task], timeout=LOOK_EVERY)
            if not task.done() and (refused := refused_subject(client, subject)):
                raise TimeoutError(refused)
        return task.result()
    finally:
        task.cancel()
        await asyncio.wait([task])


async def find_bucket(client: Any, bucket: str, options: CoordinatorOptions) -> Any:  # nats-py's own
    """Find or create a key-value bucket of NATS, check it, and return the server's status of its stream.

    The bucket must have enough replicas, be kept on disk, and never drop entries because of their age.

    Args:
        client: client of `connect_nats`.
        bucket: name of the bucket: ``busway-<zone>``.
        options: replicas, timeout and domain of the bucket.

    Raises:
        ConfigError: the credentials do not permit this, the server has no JetStream, or the bucket has too few
            replicas, is kept in memory only, or drops old entries.
        CoordinatorDown: the servers do not answer, or cannot use the bucket yet.
    """
    nats, api, errors = import_module("nats"), import_module("nats.js.api"), import_module("nats.js.errors")
    jetstream = client.jetstream(timeout=4 * options.answer, domain=options.domain)
    stream = f"KV_{bucket}"
    api_subject = f"$JS.{options.domain}.API.STREAM" if options.domain else "$JS.API.STREAM"
    try:
        try:
            # A cluster without a leader gives no answer: short, so that it is asked again soon.
            looking = client.jetstream(timeout=options.answer, domain=options.domain).stream_info(stream)
            info = await asked(client, f"{api_subject}.INFO.{stream}", looking)
        except errors.NotFoundError:
            wanted = api.StreamConfig(
                name=stream,
                subjects=[f"$KV.{bucket}.>"],
                max_msgs_per_subject=1,
                max_msg_size=LONGEST_VALUE + 1024,
                discard=api.DiscardPolicy.NEW,
                storage=api.StorageType.FILE,
                num_replicas=options.replicas,
                allow_rollup_hdrs=False,  # else a right to write one key would be one to purge all: Nats-Rollup: all
                deny_delete=True,
            )
            info = await asked(client, f"{api_subject}.CREATE.{stream}", jetstream.add_stream(wanted))
    except TimeoutError as error:
        zone = bucket.removeprefix("busway-")
        if refused := refused_subject(client, f"{api_subject}.CREATE.{stream}"):
            raise ConfigError(
                f"the bucket {bucket} is not there yet, and the credentials do not permit to make it: an operator "
                f"makes it by busway fleet apply ({refused})",
                key="coordinator",
            ) from error
        if "permissions" in client.cause.lower():
            raise ConfigError(
                f"the credentials do not permit the zone {zone}: {client.cause}",
                key="coordinator",
            ) from error
        raise CoordinatorDown(f"the bucket {bucket} does not answer in time") from error
    except errors.APIError as error:
        if error.err_code in NOT_YET:
            raise CoordinatorDown(
                f"the bucket {bucket} cannot be used yet: {client.words(error.description)}"
            ) from error
        if isinstance(error, errors.ServiceUnavailableError):
            if options.domain:
                raise CoordinatorDown(
                    f"no server of site {options.domain} answers through the centre: its line is cut, or it has not "
                    f"connected yet"
                ) from error
            raise ConfigError("the server has no JetStream: start it with -js", key="coordinator") from error
        said = client.words(error.description)
        raise ConfigError(f"the bucket {bucket} cannot be used: {said}", key="coordinator") from error
    except (nats.errors.Error, OSError) as error:
        raise CoordinatorDown(f"the bucket {bucket} does not answer: {client.words(error)}") from error
    if (info.config.num_replicas or 1) < options.replicas:
        raise ConfigError(
            f"the bucket {bucket} has {info.config.num_replicas} replicas, and {options.replicas} are asked for: "
            f"'nats stream edit {stream} --replicas {options.replicas}', or ask for fewer",
            key="replicas",
        )
    if info.config.storage != api.StorageType.FILE:
        raise ConfigError(f"the bucket {bucket} is kept in memory only: delete it, and it is made anew", key="bucket")
    if info.config.max_age:
        raise ConfigError(
            f"the bucket {bucket} forgets entries after {info.config.max_age:g} s, leases too: "
            f"'nats stream edit {stream} --max-age 0'",
            key="bucket",
        )
    return info


class _Watch:
    """Compares what one watch has shown with the answers of the server that leads the cluster (rule 3).

    Args:
        prefix: beginning of the keys that are watched.
        now: returns the time in seconds, by a clock that is never set.

    Attributes:
        messages: messages of the watch's consumer that are not shown yet.
        differs: how watch and leader disagree, in words; empty while they agree.
    """

    def __init__(self, prefix: str, now: Callable[[], float]) -> None:
        self.prefix = prefix
        self.messages: asyncio.Queue[Any] = asyncio.Queue(_MOST_WAITING)
        self.differs = ""
        self._now = now
        self._shown: dict[str, tuple[int, int]] = {}
        self._owed: dict[str, tuple[int, int | None, float]] = {}

    @property
    def keys(self) -> int:
        """The number of different keys that the watch has shown."""
        return len(self._shown)

    def show(self, key: str, revision: int, value: bytes) -> None:
        """Record that the watch has shown an entry, and compare it with the answer of the leader that it still owes."""
        self._shown[key] = revision, hash(value)
        owed, content, _ = self._owed.get(key, (0, None, 0.0))
        if owed and content == hash(value) and revision > owed:
            self.differs = f"{key} has revision {owed}, and {revision} was shown"
        elif owed and revision >= owed:
            del self._owed[key]

    def confirm(self, key: str, revision: int, value: bytes) -> None:
        """Record a change that the leader has confirmed: the watch must show its revision within `LATE` seconds.

        Ignored if the watch does not follow the key.

        Args:
            key: key of the entry.
            revision: the new revision of the entry.
            value: the new value.
        """
        if not key.startswith(self.prefix):
            return
        shown, content = self._shown.get(key, (0, 0))
        if shown > revision and content == hash(value):
            self.differs = f"{key} has revision {revision}, and {shown} was shown"
        elif shown < revision:
            self._owed.setdefault(key, (revision, hash(value), self._now()))

    def refuse(self, key: str, expected: int, revision: int) -> None:
        """Record a change that the leader has refused: the watch must show the leader's revision within `LATE` seconds.

        Ignored if the watch does not follow the key.

        Args:
            key: key of the entry.
            expected: the revision that the change expected.
            revision: the revision that the leader has.
        """
        if not key.startswith(self.prefix):
            return
        shown = self._shown.get(key, (0, 0))[0]
        if revision < expected <= shown:
            self.differs = f"{key} has revision {revision}, and {shown} was shown"
        elif shown < revision:
            self._owed.setdefault(key, (revision, None, self._now()))

    def is_right(self) -> bool:
        """Whether the watch agrees with the leader, as far as is known now; if not, ``differs`` says why."""
        if not self.differs:
            limit = self._now() - LATE
            late = [(key, revision) for key, (revision, _, since) in self._owed.items() if since < limit]
            if late:
                key, revision = late[0]
                shown = self._shown.get(key, (0, 0))[0]
                self.differs = f"{key} has revision {revision}, and after {LATE:g} s only {shown} was shown"
        return not self.differs


class NatsCoordinator:
    """The shared table of a zone's collectors in a key-value bucket of NATS.

    Args:
        client: client of `connect_nats`; closed by `close`.
        bucket: name of the bucket, which exists.
        answer: seconds to wait for the answer to a change.
        domain: JetStream domain of the edge site that has the bucket; None for the server that ``client`` is connected
            to.

    Attributes:
        client: the client of nats-py, for the streams of the same collector.
        replicas: number of servers that keep each entry; set by `open_nats`.
        is_clustered: whether the server belongs to a cluster; set by `open_nats`.
    """

    def __init__(self, client: Any, bucket: str, answer: float, domain: str | None = None) -> None:
        self.client: Any = client
        self.replicas: int = 1
        self.is_clustered: bool = False
        self._bucket, self._answer = bucket, answer
        self._jetstream = client.jetstream(timeout=answer, domain=domain)
        self._api = f"$JS.{domain}.API" if domain else "$JS.API"
        self._keys = in_domain(f"$KV.{bucket}.", domain) if domain else f"$KV.{bucket}."
        self._watches: set[_Watch] = set()
        self._outages = OutageLog()
        self._at_leader = False

    async def create(self, key: str, value: bytes) -> int:
        """Add a new entry to the shared table, and return its revision. Arguments and errors: `Coordinator.create`."""
        return await self._changed(key, value, 0)

    async def replace(self, key: str, value: bytes, revision: int) -> int:
        """Change an entry of the shared table if it still has this revision, and return its new revision.

        Arguments and errors: `Coordinator.replace`.
        """
        return await self._changed(key, value, revision)

    async def _changed(self, key: str, value: bytes, revision: int) -> int:
        nats, errors = import_module("nats"), import_module("nats.js.errors")
        if len(value) > LONGEST_VALUE:
            raise ConfigError(f"an entry has up to {LONGEST_VALUE} bytes, not {len(value)}", key=key)
        if not self.client.is_connected:
            cause = self.client.cause
            refused = "the server refuses the credentials" if _is_refusal(cause) else "the connection is lost"
            raise CoordinatorDown(f"{refused}: {cause}" if cause else refused)
        try:
            made = await self._jetstream.publish(
                f"{self._keys}{key}", value, headers={"Nats-Expected-Last-Subject-Sequence": str(revision)}
            )
        except errors.NoStreamResponseError as error:
            raise CoordinatorDown("no server has the bucket now") from error
        except errors.APIError as error:
            if error.err_code in _WRONG_SEQUENCE:
                if found := _SEQUENCE.search(error.description or ""):
                    for watch in self._watches:
                        watch.refuse(key, revision, int(found[1]))
                raise RevisionConflict(
                    f"{key} has not revision {revision}: {self.client.words(error.description)}"
                ) from error
            raise OutcomeUnknown(f"the server answers: {self.client.words(error.description)}") from error
        except (nats.errors.Error, OSError, TimeoutError) as error:
            if refused := refused_subject(self.client, f"{self._keys}{key}"):
                raise CoordinatorDown(f"the credentials do not permit to change {key}: {refused}") from error
            cause = self.client.cause or self.client.words(error)
            raise OutcomeUnknown(f"the server does not answer: {cause}") from error
        for watch in self._watches:
            watch.confirm(key, int(made.seq), value)
        return int(made.seq)

    async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        """Yield the entries whose keys begin with ``prefix``, then their changes, until closed: `Coordinator.watch`."""
        first, was_complete = True, False
        while True:
            if not first:
                yield SNAPSHOT_BEGINS
            first = False
            async with contextlib.aclosing(self._once(prefix, was_complete=was_complete)) as entries:
                async for entry in entries:
                    was_complete = was_complete or entry is SNAPSHOT_ENDS
                    yield entry
            await asyncio.sleep(0.2)

    async def _once(self, prefix: str, *, was_complete: bool) -> AsyncGenerator[Entry, None]:
        """Yield the entries of the shared table, then `SNAPSHOT_ENDS`, then their changes, from one NATS consumer.

        Ends without an error when a message of the consumer is missing, when it is silent for `QUIET` seconds, when it
        disagrees with the leader, or after an error of the server or the connection.

        Raises:
            ConfigError: the credentials do not permit the consumer, and ``was_complete`` is False.
        """
        nats, errors = import_module("nats"), import_module("nats.js.errors")
        watch, subscription = _Watch(prefix, time.monotonic), None
        self._watches.add(watch)
        try:
            subscription, pending = await self._consume(watch)
            complete_at = time.monotonic() + QUIET
            if not pending:
                self._outages.complete()
                yield SNAPSHOT_ENDS
            follows = 1
            while not watch.messages.empty() or watch.is_right():
                async with asyncio.timeout(QUIET):
                    message = await watch.messages.get()
                if (message.headers or {}).get("Status") is not None:
                    last = message.headers.get("Nats-Last-Consumer")
                    if last is not None and int(last) >= follows:
                        return
                else:
                    data = message.metadata
                    if data.sequence.consumer != follows:
                        return
                    follows += 1
                    key = message.subject.removeprefix(f"$KV.{self._bucket}.")
                    watch.show(key, data.sequence.stream, message.data)
                    if key.startswith(prefix):
                        yield Entry(key, message.data, data.sequence.stream, data.timestamp.timestamp())
                    if not data.num_pending or watch.keys >= pending:
                        complete_at = 0.0
                if pending and time.monotonic() >= complete_at:
                    pending = 0
                    self._outages.complete()
                    yield SNAPSHOT_ENDS
            _log.warning(
                "the servers of NATS do not agree on the table of the zone (%s): it is read anew where the leader is",
                watch.differs,
            )
            self._at_leader = True
        except TimeoutError as error:
            refused = refused_subject(self.client, f"{self._api}.CONSUMER.CREATE.KV_{self._bucket}")
            if refused and not was_complete:
                raise ConfigError(
                    f"the credentials do not permit to read the table {self._bucket}: {refused}", key="coordinator"
                ) from error
            self._outages.lost(self.client.cause or str(error) or f"the server is silent for {QUIET:g} s")
            return
        except (nats.errors.Error, errors.Error, OSError) as error:
            self._outages.lost(self.client.cause or self.client.words(error))
            return
        finally:
            self._watches.discard(watch)
            if subscription is not None:
                with contextlib.suppress(nats.errors.Error, OSError):
                    await subscription.unsubscribe()

    async def _consume(self, watch: _Watch) -> tuple[Any, int]:
        """Create the NATS consumer that follows the shared table; return its subscription and how many entries exist.

        Messages of the consumer come to ``watch.messages``, which is replaced. After servers have disagreed, consumers
        are created until one is on the leader, `MOST_TRIES` at most. If none is, the subscription of the last one is
        ended: then no message comes, and the watch begins anew after `QUIET` seconds.
        """
        leader, stream = None, f"KV_{self._bucket}"
        if self._at_leader:
            cluster = (await self._jetstream.stream_info(stream)).cluster
            leader = None if cluster is None else cluster.leader
        for _ in range(MOST_TRIES):
            inbox = self.client.new_inbox()
            messages: asyncio.Queue[Any] = asyncio.Queue(_MOST_WAITING)

            async def came(message: Any, messages: asyncio.Queue[Any] = messages) -> None:
                with contextlib.suppress(asyncio.QueueFull):  # a gap then: the watch begins anew
                    messages.put_nowait(message)

            subscription = await self.client.subscribe(inbox, cb=came)
            try:
                info = await self._jetstream.add_consumer(stream, self._consumer(inbox))
            except BaseException:
                await subscription.unsubscribe()
                raise
            if leader is None or info.cluster is None or info.cluster.leader == leader:
                break
            await subscription.unsubscribe()
        watch.messages = messages
        return subscription, int(info.num_pending or 0) + int(info.delivered.consumer_seq if info.delivered else 0)

    def _consumer(self, inbox: str) -> Any:
        api = import_module("nats.js.api")
        return api.ConsumerConfig(
            deliver_subject=inbox,
            deliver_policy=api.DeliverPolicy.LAST_PER_SUBJECT,
            ack_policy=api.AckPolicy.NONE,
            filter_subject=f"$KV.{self._bucket}.>",
            idle_heartbeat=HEARTBEAT,
            max_deliver=1,
            mem_storage=True,
            num_replicas=1,
        )

    async def close(self) -> None:
        """Close the connection to NATS. The shared table stays as it is."""
        await _close(self.client)

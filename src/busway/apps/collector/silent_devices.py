"""The silent devices of one link: when a device is left out because it does not answer, and how soon it is asked again.

Pure: every call gets the time as an argument; knows no clock, no socket, no read and no poll class. The schedule of the
link (`schedule`) says which device answered and which did not, does not poll the silent ones, and asks which to probe.

1. A device is silent from its first read without an answer until it answers a read. If it was polled before, it is
   probed at once, so that a single lost reply costs one or two rounds.
2. After each further read without an answer the pause before the next probe doubles: from the shortest poll period of
   the device up to `LONGEST_BACKOFF`. An answer to a write makes the pause short again, but does not end the silence.
3. In the long run all probes of a link together use at most `DEAD_SHARE` of its time. For a short time they can use up
   to two timeouts more: one that was saved up while no probe was due, and one of a probe that began just before the
   share was used up. So with timeouts of 1 s, probes can take 8 % of a single minute.
4. Devices that were asked while the link was down are all probed at once when one of them answers again.
5. A device in maintenance is not probed; if it is silent, it is probed at once afterwards.
"""

import heapq
from dataclasses import dataclass
from itertools import count
from typing import Final

DEAD_SHARE: Final = 0.05
"""Share of a link's time, 0…1, that all probes of silent devices may use together in the long run (rule 3)."""
LONGEST_BACKOFF: Final = 60.0
"""Longest pause in seconds before the next probe of a silent device, unless `DEAD_SHARE` makes it longer."""
_MOST_DOUBLINGS: Final = 20
_ROUNDING: Final = 1e-9
"""What sums of times may differ by, in seconds."""


@dataclass(slots=True)
class _Silence:
    """The silence of a device.

    Attributes:
        unanswered: reads without an answer, in a row; those that failed because the link was down count too.
        probe_at: when the device may be probed next; None while it answers, and while it is in maintenance.
        was_down: whether its last request failed because the link was down.
    """

    unanswered: int = 0
    probe_at: float | None = None
    was_down: bool = False


class SilentDevices:
    """Decides which silent device of a link is probed next, and when; limits the time that probes take.

    Args:
        timeout: seconds that a probe without a reply takes.
        share: share of the link's time that probes may use, above 0 and at most 1.

    Attributes:
        probing: seconds that probes of silent devices took so far.
    """

    def __init__(self, timeout: float, share: float = DEAD_SHARE) -> None:
        self.probing: float = 0.0
        self._timeout = timeout
        self._share = share
        self._credit = timeout
        self._credited_at: float | None = None
        self._silences: dict[str, _Silence] = {}
        self._probes: list[tuple[float, int, str]] = []
        self._numbers = count()

    # Devices and what they answered.

    def add(self, name: str) -> None:
        """Add a device of the link, of which nothing is known; forgets what was known of one with this name."""
        self._silences[name] = _Silence()

    def remove(self, name: str) -> None:
        """Forget a device."""
        self._silences.pop(name, None)

    def answered(self, name: str, now: float, *, is_read: bool) -> None:
        """Record that a device answered; after a lost link, let the others be probed at once (rule 4).

        Args:
            name: name of the device.
            now: the time.
            is_read: whether it answered a read, which ends its silence; False for a write.
        """
        silence = self._silences[name]
        silence.unanswered = 0
        if is_read:
            silence.probe_at = None
        if not silence.was_down:
            return
        for other_name, other in self._silences.items():
            if other.was_down:
                other.was_down = False
                if other.probe_at is not None:
                    self._probe_at(other_name, now)

    def unanswered(self, name: str, now: float, period: float, *, was_polled: bool, was_down: bool) -> None:
        """Record that a device did not answer a read, and set the time of its next probe (rules 1, 2).

        Args:
            name: name of the device.
            now: the time.
            period: the shortest poll period of the device, in seconds.
            was_polled: whether the device answered its last read before this one.
            was_down: whether the link was down, so that the device may answer all the same.
        """
        silence = self._silences[name]
        silence.unanswered += 1
        silence.was_down = was_down
        doublings = min(max(silence.unanswered - 2, 0), _MOST_DOUBLINGS)
        self._probe_at(name, now if was_polled else now + min(period * 2**doublings, LONGEST_BACKOFF))

    def leave_alone(self, name: str) -> None:
        """Do not probe a device until `probe_now`, because it is in maintenance (rule 5)."""
        self._silences[name].probe_at = None

    def probe_now(self, name: str, now: float) -> None:
        """Let a silent device be probed at once, because its maintenance has ended."""
        self._probe_at(name, now)

    def _probe_at(self, name: str, when: float) -> None:
        self._silences[name].probe_at = when
        heapq.heappush(self._probes, (when, next(self._numbers), name))

    # The time of probes (rule 3).

    def credit_until(self, now: float) -> None:
        """Add the share of the time since the last call to what probes may use: in all one timeout at most."""
        if self._credited_at is not None:
            gained = self._share * (now - self._credited_at)
            self._credit = min(self._credit + gained, self._timeout)
        self._credited_at = now

    def probed(self, seconds: float, *, is_silent: bool) -> None:
        """Record the time that a probe took.

        Args:
            seconds: the time.
            is_silent: whether the probe was of a silent device; False for the first read of a device that answered it,
                which uses the share of probes, but does not count in `probing`.
        """
        self._credit -= seconds
        if is_silent:
            self.probing += seconds

    @property
    def has_saved_a_timeout(self) -> bool:
        """Whether a whole timeout is saved up for probes: then one goes first, however much else is due."""
        return self._credit >= self._timeout - _ROUNDING

    # Which device is probed next.

    def take_due(self, now: float) -> str | None:
        """Return the name of the silent device to probe now, which then waits for the result; None if none is due."""
        name = self._first()
        if name is None or self._probes[0][0] > now or self._credit < -_ROUNDING:
            return None
        heapq.heappop(self._probes)
        return name

    def next_probe_at(self, now: float) -> float | None:
        """Return when the next probe is due, as soon as the share allows it; None if no device is to be probed."""
        if self._first() is None:
            return None
        has_credit_at = now - min(self._credit, 0.0) / self._share
        return max(self._probes[0][0], has_credit_at)

    def _first(self) -> str | None:
        """Return the name of the device whose probe is first among those noted, due or not; drops outdated ones."""
        while self._probes:
            when, _, name = self._probes[0]
            silence = self._silences.get(name)
            if silence is not None and silence.probe_at == when:
                return name
            heapq.heappop(self._probes)
        return None

    def longest_wait(self, silent: int) -> float:
        """Return the longest time in seconds until a device that could answer again is probed.

        Args:
            silent: number of devices of the link that do not answer, or were not asked yet.
        """
        return LONGEST_BACKOFF + (silent + 1) * self._timeout / self._share

"""Whether a writer may write a point, by its role and by whether the command was armed: the one place that decides.

Pure: knows the rule of a point and a role; knows no caller, no message and no clock.

1. Every way to write has a role. A caller of the page or the API has a role of its own; messages from a broker or
   server have the role in their table ``commands``; a program and a request to a fleet have `configure`, because they
   could change the configuration as well.
2. Writing a point needs the role `operate`, or `configure` if the point's rule says so.
3. If its rule says so, a point is written only by a command that was armed and then confirmed by the same writer.
"""

from dataclasses import dataclass
from typing import Final

from ....points.point_rules import WriteRule

_RANKS: Final = {"view": 1, "operate": 2, "configure": 3}


@dataclass(frozen=True, slots=True)
class WriterRights:
    """What the writer of a command may do.

    Attributes:
        role: ``view``, ``operate`` or ``configure``; each includes the rights of those before it.
        has_armed: whether the command was armed and has been confirmed.
    """

    role: str = "configure"
    has_armed: bool = False

    def refusal(self, rule: WriteRule | None) -> str:
        """Return why the writer may not write a point, as the end of a sentence; empty if the writer may.

        Args:
            rule: the point's rule for writing; None for a point without one, for which the role ``operate`` is enough.
        """
        needed = "operate" if rule is None else rule.role
        if _RANKS[self.role] < _RANKS[needed]:
            return f"needs the role {needed}, and the writer has {self.role}; nothing was sent"
        if rule is not None and rule.armed and not self.has_armed:
            return "must be armed and then confirmed; nothing was sent"
        return ""

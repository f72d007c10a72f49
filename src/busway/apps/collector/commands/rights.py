"""Whether a writer may write a point, by its role and by whether the command was armed: the one place that decides.

Pure: knows the rule of a point and a role; knows no caller, no message and no clock.

1. Every way to write has a role: a caller of the page and the API its own, messages from a broker or server that of
   their ``commands``, a program and a request to a fleet `configure`, because they could change the file as well.
2. A point asks for `operate`, or by its rule for `configure`.
3. A point whose rule says so is written only by a command that was armed and then confirmed by the same writer.
"""

from dataclasses import dataclass
from typing import Final

from ....points.point_rules import WriteRule

_RANKS: Final = {"view": 1, "operate": 2, "configure": 3}


@dataclass(frozen=True, slots=True)
class WriterRights:
    """What the writer of a command may do.

    Attributes:
        role: ``view``, ``operate`` or ``configure``; each includes those before it.
        has_armed: whether the command was armed and is confirmed now.
    """

    role: str = "configure"
    has_armed: bool = False

    def refusal(self, rule: WriteRule | None) -> str:
        """Return why a point with this rule may not be written, as a sentence; empty if it may."""
        needed = "operate" if rule is None else rule.role
        if _RANKS[self.role] < _RANKS[needed]:
            return f"needs the role {needed}, and the writer has {self.role}; nothing was sent"
        if rule is not None and rule.armed and not self.has_armed:
            return "must be armed and then confirmed; nothing was sent"
        return ""

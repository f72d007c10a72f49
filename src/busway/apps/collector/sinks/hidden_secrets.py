"""Hides passwords and tokens in texts of servers, which may send back what they were sent.

Pure.
"""

import json
import re


class HiddenSecrets:
    """The passwords and tokens of a connection, to be hidden in errors of its server.

    Args:
        secrets: None or empty where there is none.
    """

    def __init__(self, *secrets: str | None) -> None:
        given = [each for each in secrets if each]
        written = {form for each in given for form in (each, json.dumps(each)[1:-1])}  # NATS is told them in JSON
        longest_first = sorted(written, key=len, reverse=True)
        self._pattern = re.compile("|".join(map(re.escape, longest_first)), re.IGNORECASE) if given else None

    def hide(self, text: object) -> str:
        """Return a text, or that of an error, with ``***`` in the place of each secret."""
        return str(text) if self._pattern is None else self._pattern.sub("***", str(text))

    def __repr__(self) -> str:
        return "HiddenSecrets(***)"

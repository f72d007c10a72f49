"""Hides passwords and tokens in error texts of servers, which may repeat what they were sent.

Pure.
"""

import json
import re


class HiddenSecrets:
    """Hides the passwords and tokens of a connection in error texts of its server.

    Args:
        secrets: the passwords and tokens; None and empty texts are ignored.
    """

    def __init__(self, *secrets: str | None) -> None:
        given = [each for each in secrets if each]
        written = {form for each in given for form in (each, json.dumps(each)[1:-1])}  # NATS is told them in JSON
        longest_first = sorted(written, key=len, reverse=True)
        self._pattern = re.compile("|".join(map(re.escape, longest_first)), re.IGNORECASE) if given else None

    def hide(self, text: object) -> str:
        """Return ``str(text)`` with ``***`` in place of each secret.

        Secrets are found in upper and lower case, and also in the form that JSON gives them.
        """
        return str(text) if self._pattern is None else self._pattern.sub("***", str(text))

    def __repr__(self) -> str:
        return "HiddenSecrets(***)"

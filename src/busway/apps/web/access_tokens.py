"""The file with the access tokens of a page: created at the first start, for its owner alone, read again after changes.

Knows the file and its lines; knows no request.

::

    # role token name
    view      kSp3…
    operate   9fQx…
    operate   Zw0a…   anna

1. A new file has one random token for each role. The program never changes the file afterwards: lines are added and
   removed by hand.
2. A file that other users can read is refused, and so is a file with an invalid line; the error has the line's number
   and never its token.
3. A file that becomes invalid while a page runs is logged, and adds no token. A token that is no longer in the file, or
   whose file is gone, is no longer accepted.
"""

import logging
import os
import secrets
import stat
from pathlib import Path
from typing import Final

from ...errors import ConfigError
from ...safe_files import read_safely
from .request_guard import ROLES, AccessToken, Role

TOKEN_FILE: Final = "page-tokens"
"""Name of the file in the folder of the store."""
SHORTEST_TOKEN: Final = 16
"""Smallest number of characters in a token that a user chooses."""
MOST_TOKENS: Final = 100
_TOKEN_BYTES: Final = 24
_LONGEST_FILE: Final = 64 * 1024
_HEAD: Final = "# role token name: a token permits what its role does. Keep this file secret.\n"

_log = logging.getLogger("busway.apps.web")


def new_token() -> str:
    """Return a random access token of 32 characters."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


def is_token(text: str) -> bool:
    """Whether a text is long enough for an access token, and valid in a header, a subprotocol and a URL fragment."""
    return len(text) >= SHORTEST_TOKEN and text.isascii() and all(one.isalnum() or one in "-._~" for one in text)


class KeptTokens:
    """The access tokens of a web page, read from a file, and read again after the file has changed.

    Args:
        path: the file. If it does not exist, it is created with a new token for each role.

    Raises:
        ConfigError: the file cannot be created or read, other users can read it, or a line is invalid.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        _make(path)
        self._state = self._look()
        self._tokens = read_tokens(path)

    def current(self) -> tuple[AccessToken, ...]:
        """Return the access tokens that are valid now, after reading the file again if it has changed; never raises.

        If the file has become invalid, only tokens that were valid before and are still in the file are returned.
        """
        state = self._look()
        if state != self._state:
            self._state = state
            try:
                self._tokens = read_tokens(self.path)
            except ConfigError as error:
                self._tokens = self._left()
                _log.error("no tokens are added to the %d of the page that are left: %s", len(self._tokens), error)
        return self._tokens

    def _left(self) -> tuple[AccessToken, ...]:
        """Return the tokens that were valid before and are still in an invalid file; empty if it cannot be read."""
        try:
            text = read_safely(self.path, most=_LONGEST_FILE).decode("utf-8", "replace")
        except ConfigError:
            return ()
        lines = (line.split(maxsplit=2) for line in text.splitlines())
        words = {(words[0], AccessToken.of(words[1], "", Role.VIEW).digest) for words in lines if len(words) > 1}
        return tuple(each for each in self._tokens if (each.caller.role.label, each.digest) in words)

    def _look(self) -> tuple[int, ...]:
        try:
            found = self.path.stat()
        except OSError:
            return ()
        return found.st_ino, found.st_ctime_ns, found.st_mtime_ns, found.st_size, found.st_mode


def read_tokens(path: Path) -> tuple[AccessToken, ...]:
    """Return the access tokens in a file, in the order of its lines.

    Raises:
        ConfigError: the file cannot be read, other users can read it, a line is invalid, or the file has no token or
            more than `MOST_TOKENS`.
    """
    text = read_safely(path, most=_LONGEST_FILE).decode("utf-8", "replace")
    if os.name != "nt" and path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError("holds tokens and can be read by others; chmod 600 it", file=str(path))
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split(maxsplit=2)
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in ROLES:
            raise ConfigError(f"line {number}: a line begins with {', '.join(ROLES)} or #", file=str(path))
        if len(words) == 1 or not is_token(words[1]):
            sentence = f"a token has at least {SHORTEST_TOKEN} letters, digits, - . _ and ~"
            raise ConfigError(f"line {number}: {sentence}", file=str(path))
        role = ROLES[words[0]]
        found.append(AccessToken.of(words[1], words[2].strip() if len(words) == 3 else role.label, role))
    if len(found) > MOST_TOKENS:
        raise ConfigError(f"has more than {MOST_TOKENS} tokens", file=str(path))
    if not found:
        raise ConfigError("has no token; remove it, and new ones are made", file=str(path))
    return tuple(found)


def _make(path: Path) -> None:
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        return
    except OSError as error:
        raise ConfigError(f"cannot be made: {error.strerror}", file=str(path)) from error
    try:
        with os.fdopen(handle, "w", encoding="ascii") as file:
            file.write(_HEAD + "".join(f"{role.label:<9} {new_token()}\n" for role in Role))
            file.flush()
            os.fsync(handle)  # without its content, after a power failure, it would be refused
    except OSError as error:  # a full disk
        path.unlink()
        raise ConfigError(f"cannot be written: {error.strerror}", file=str(path)) from error

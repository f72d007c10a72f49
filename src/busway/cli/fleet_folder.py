"""Which coordinator ``busway fleet`` uses: the one that the user names, or a folder of this user on this machine.

1. ``--coordinator`` is preferred to the variable BUSWAY_FLEET, and that to the folder ``busway/fleet`` in
   $XDG_STATE_HOME (by default ``~/.local/state``). This is the same for all actions.
2. A folder serves collectors of one machine only. If no coordinator is named but an option needs a server, the command
   is refused: the user expects that a server is asked.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from ..errors import ConfigError
from .output import say

NATS: Final = "nats://host:4222"
SERVERS: Final = f"{NATS} or postgresql://user@host/database"
_NEEDS: Final = {
    "sink": NATS,
    "write": NATS,
    "--stream": NATS,
    "--credentials": NATS,
    "--system-credentials": NATS,
    "--domain": NATS,
    "--replicas": NATS,
    "--user": SERVERS,
    "--ca": SERVERS,
    "--certificate": SERVERS,
    "--private-key": SERVERS,
    "BUSWAY_FLEET_CREDENTIALS": NATS,
    "BUSWAY_FLEET_PASSWORD": SERVERS,
    "BUSWAY_FLEET_CA": SERVERS,
}
"""The actions, options and environment variables that need a server, with the form of the servers' URLs.

With a folder as coordinator they are refused.
"""


def chosen_coordinator(
    named: str | None, given: Mapping[str, object], environment: Mapping[str, str] | None = None
) -> str:
    """Return the URL of the coordinator that ``--coordinator`` or the variable BUSWAY_FLEET names.

    If neither names one, it is ``local:FOLDER`` with the folder of this user, which is printed on stderr.

    Args:
        named: the URL of ``--coordinator``; None if it is not given.
        given: action and options of the command line, by name; those with a false value are not given.
        environment: the environment variables; None for those of this process.

    Raises:
        ConfigError: no coordinator is named, and something in ``given`` or in the environment needs a server; or this
            user has no home folder.
    """
    variables = os.environ if environment is None else environment
    url = named or variables.get("BUSWAY_FLEET")
    if url:
        return url
    folder = state_folder(variables) / "fleet"
    for name, needed in _NEEDS.items():
        if given.get(name) or variables.get(name):
            raise ConfigError(
                f"needs --coordinator {needed}; none is named, and collectors of this machine share the folder "
                f"{folder}",
                key=name,
            )
    say(f"the coordinator is local:{folder}, for collectors of this machine alone; --coordinator names another one")
    return f"local:{folder}"


def state_folder(environment: Mapping[str, str]) -> Path:
    """Return the folder for busway's state of this user: ``busway`` in $XDG_STATE_HOME or ``~/.local/state``.

    A relative $XDG_STATE_HOME is ignored (https://specifications.freedesktop.org/basedir-spec/latest).

    Raises:
        ConfigError: the environment names no folder, and the user has no home.
    """
    state = environment.get("XDG_STATE_HOME", "")
    if not os.path.isabs(state):
        home = environment.get("HOME") or os.path.expanduser("~")
        if not os.path.isabs(home):
            raise ConfigError(f"is needed, as this user has no home: local:FOLDER, {SERVERS}", key="--coordinator")
        state = os.path.join(home, ".local", "state")
    return Path(state) / "busway"

"""Which coordinator a command of ``busway fleet`` asks: the named one, or a folder of this user on this machine.

1. ``--coordinator`` counts before BUSWAY_FLEET, and that before the folder ``busway/fleet`` in $XDG_STATE_HOME
   (``~/.local/state``). All actions use the same.
2. A folder is for one machine. A command that was given what only a server has is refused instead of using the folder:
   its user believes that a server is asked.
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
"""By action, option or environment variable that a folder does not serve: the coordinators that do."""


def chosen_coordinator(
    named: str | None, given: Mapping[str, object], environment: Mapping[str, str] | None = None
) -> str:
    """Return the URL of the coordinator to ask, and say so where that is the folder of this machine.

    Args:
        named: the URL on the command line; None for none.
        given: by name, what else is on the command line; false values were not given.
        environment: the environment variables; None for those of this process.

    Raises:
        ConfigError: no coordinator is named, and something was given that needs a server, or there is no folder.
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
    """Return the folder in which busway keeps what it must remember for this user.

    https://specifications.freedesktop.org/basedir-spec/latest: a relative path is not valid.

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

"""Counts all scripts and prints JSON: ``{"python": "3.11", "scripts": {name: {calls, instructions, bytes, layers}}}``.

Run from `bench/`: python -m offline.guard
"""

import json
import sys
from dataclasses import asdict

from offline.counting import count
from offline.scripts import SCRIPTS

found = {name: asdict(count(script)) for name, script in SCRIPTS.items()}
print(json.dumps({"python": "{}.{}".format(*sys.version_info[:2]), "scripts": found}))

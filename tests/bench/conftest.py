"""Lets these tests import the benchmark, which is no package: its programs run in its folder."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
for folder in ("bench", "scripts"):
    sys.path.insert(0, str(ROOT / folder))

"""Servers in processes of their own."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from told_program import Program

SERVER = Path(__file__).parent / "programs" / "server.py"
StartServer = Callable[..., Program]


@pytest.fixture
def start_server() -> Iterator[StartServer]:
    """Starts a server with the options given, on a free port of ``endpoint``; it is ended with the test."""
    with ExitStack() as stack:

        def start(endpoint: str = "tcp://127.0.0.1:0", **options: Any) -> Program:
            return stack.enter_context(Program([sys.executable, str(SERVER), endpoint, json.dumps(options)]))

        yield start

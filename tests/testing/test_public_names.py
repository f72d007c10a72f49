"""What `busway.testing` offers."""

import subprocess
import sys

import pytest

import busway.testing


def test_every_public_name_is_there_and_described() -> None:
    for name in busway.testing.__all__:
        assert getattr(busway.testing, name).__doc__, name
    assert dir(busway.testing) == sorted(busway.testing.__all__)


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        busway.testing.no_such_name  # noqa: B018 - reading it is the test


def test_package_is_imported_without_its_parts() -> None:
    program = "import busway.testing, sys; sys.exit('asyncio' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0

"""Fixtures of the tests of servers."""

import pytest

import busway.server.opening


@pytest.fixture(params=["in an epoll set", "by the loop's transports"])
def transport(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both ways for connections to wait; the second one is for event loops and systems without an epoll object."""
    name: str = request.param
    if name == "by the loop's transports":
        monkeypatch.setattr(busway.server.opening, "epoll_set_for", lambda loop: None)
    return name

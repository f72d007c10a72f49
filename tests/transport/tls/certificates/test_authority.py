"""Certificates that the authority for tests issues, and those that cannot be."""

from collections.abc import Callable

import pytest

from busway.errors import ConfigError
from busway.transport.tls.certificates.authority import Authority, Issued


@pytest.mark.parametrize(
    ("issue", "days"),
    [
        (lambda authority: authority.client("pump", days=1, starts_in=2), "1"),
        (lambda authority: authority.client("pump", days=-2, starts_in=1), "-2"),
        (lambda authority: authority.server(["localhost"], days=0.5, starts_in=30), "0.5"),
    ],
)
def test_certificate_that_would_expire_before_it_begins_is_refused(
    issue: Callable[[Authority], Issued], days: str
) -> None:
    with pytest.raises(ConfigError, match=f"expires in {days} days") as refusal:
        issue(Authority.create())
    assert refusal.value.key == "starts_in"


def test_certificate_may_begin_later_or_have_expired() -> None:
    authority = Authority.create()
    later = authority.client("pump", days=3, starts_in=2).certificate
    expired = authority.client("pump", days=-2).certificate
    for one in (later, expired):
        assert one.not_valid_before_utc < one.not_valid_after_utc
    assert expired.not_valid_after_utc < later.not_valid_before_utc

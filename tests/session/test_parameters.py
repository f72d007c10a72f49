"""What can be set about a conversation: the documented defaults, both edges, and sentences that name the key."""

import dataclasses
from typing import Any

import pytest

from busway.errors import ConfigError
from busway.options.client import ClientParameters, MismatchPolicy, TransactionScope
from busway.options.server import Scope, ServerParameters


@pytest.mark.clause("T23")
@pytest.mark.clause("T26")
def test_the_defaults_of_a_client_are_those_of_the_documentation() -> None:
    assert dataclasses.asdict(ClientParameters()) == {
        "timeout": 1.0,
        "retries": 1,
        "write_retries": 0,
        "deadline": None,
        "max_transactions": 1,
        "scope": TransactionScope.CONNECTION,
        "queue": 64,
        "transaction_policy": MismatchPolicy.STRICT,
        "unit_policy": MismatchPolicy.STRICT,
        "recycle_after_timeouts": 3,
        "recycle_after_foreign": 16,
        "single_adu_segments": False,
        "connect_delay": 0.0,
        "request_gap": 0.0,
        "register_width": 2,
    }


@pytest.mark.clause("T27")
def test_the_defaults_of_a_server_are_those_of_the_documentation() -> None:
    assert dataclasses.asdict(ServerParameters()) == {
        "max_transactions": 16,
        "scope": Scope.CONNECTION,
        "diagnostics_changes": None,
    }


@pytest.mark.parametrize(
    ("key", "low", "high", "beyond"),
    [
        ("timeout", 0.001, 3600, (0, -1, 3601, float("nan"))),
        ("retries", 0, 100, (-1, 101)),
        ("write_retries", 0, 100, (-1, 101)),
        ("deadline", 0.001, 86_400, (0, 86_401)),
        ("max_transactions", 1, 16, (0, 17)),
        ("queue", 1, 65_536, (0, 65_537)),
        ("recycle_after_timeouts", 1, 1000, (0, 1001)),
        ("recycle_after_foreign", 1, 1000, (0, 1001)),
        ("connect_delay", 0, 60, (-0.1, 61)),
        ("request_gap", 0, 60, (-0.1, 61)),
    ],
)
def test_a_value_is_taken_up_to_both_edges_and_refused_beyond_by_name(
    key: str, low: float, high: float, beyond: tuple[float, ...]
) -> None:
    for value in (low, high):
        options: dict[str, Any] = {key: value}
        assert getattr(ClientParameters(**options), key) == value
    for value in beyond:
        options = {key: value}
        with pytest.raises(ConfigError, match=rf"^{key}: must be {low:g}…{high:g}, not") as caught:
            ClientParameters(**options)
        assert caught.value.key == key


@pytest.mark.clause("T27")
@pytest.mark.parametrize("value", [0, 17])
def test_a_server_has_1_to_16_transactions(value: int) -> None:
    with pytest.raises(ConfigError, match="max_transactions: must be 1…16"):
        ServerParameters(max_transactions=value)
    assert ServerParameters(max_transactions=1, scope=Scope.SERVER).scope is Scope.SERVER


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"transaction_policy": "lax"}, "transaction_policy: must be one of strict, automatic, ignore, not 'lax'"),
        ({"unit_policy": None}, "unit_policy: must be one of strict, automatic, ignore, not None"),
        (
            {"transaction_policy": MismatchPolicy.IGNORE, "max_transactions": 2},
            "transaction_policy: ignore goes with max_transactions 1 only",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        ClientParameters(**options)
    assert str(caught.value) == sentence


def test_a_servers_scope_is_one_of_two() -> None:
    with pytest.raises(ConfigError, match="scope: must be connection or server, not 'all'"):
        ServerParameters(scope="all")  # type: ignore[arg-type]


def test_parameters_do_not_change() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        ClientParameters().timeout = 2.0  # type: ignore[misc]

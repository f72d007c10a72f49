"""Messages with live values, as programs of others read them."""

import json
import math

import pytest

from busway.apps.collector.samples import PointGroup, SampleBatch
from busway.apps.fleet.live_subjects import encoded_batch


def no_json(word: str) -> None:
    raise AssertionError(f"{word} is not in JSON")


@pytest.mark.parametrize(("value", "text"), [(math.nan, "nan"), (math.inf, "inf"), (-math.inf, "-inf")])
def test_values_that_json_cannot_represent_are_texts_as_in_the_documents_of_sinks(value: float, text: str) -> None:
    batch = SampleBatch(PointGroup("meter", ("power", "state")), 7_000_000, 5, (value, 1.5))
    message = json.loads(encoded_batch(batch), parse_constant=no_json)
    assert message == {"device": "meter", "time": 7, "points": {"power": {"value": text}, "state": {"value": 1.5}}}

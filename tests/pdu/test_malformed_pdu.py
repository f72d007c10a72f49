"""What a broken rule is as an error."""

from busway.pdu.malformed_pdu import MalformedPdu


def test_a_malformed_pdu_names_the_rule_and_the_exception_code_it_earns() -> None:
    error = MalformedPdu("count must be 1…125, not 126")
    assert (error.reason, error.code, str(error)) == ("count must be 1…125, not 126", 3, error.reason)
    assert MalformedPdu("reference type 5", 2).code == 2
    assert isinstance(error, ValueError)

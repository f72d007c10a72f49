from busway.apps.fleet.epoch import Epoch


def test_a_generation_outweighs_every_revision() -> None:
    assert Epoch(2, 1) > Epoch(1, 10_000)
    assert str(Epoch(2, 17)) == "2.17"

"""How many examples the properties of a test get.

Where `FEW` is in the environment, each property gets a tenth: on a second and third Python the question is whether the
code runs there, and no longer whether it is right.
"""

import os

FEW = "BUSWAY_FEW_EXAMPLES"


def examples(count: int) -> int:
    """Return the number of examples for a property that wants ``count``; at least ten."""
    return max(10, count // 10) if FEW in os.environ else count

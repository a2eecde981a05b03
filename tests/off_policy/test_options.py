"""What cannot be asked of an estimate."""

from typing import Any

import pytest

from ucfrec.errors import InputError
from ucfrec.off_policy.options import EstimateOptions


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"discount": 0.0}, "discount is 0.0"),
        ({"discount": 1.1}, "at most 1"),
        ({"reward_range": (2.0, 1.0)}, "name the least one first"),
        ({"wanted_lift": 0.0}, "above 0"),
        ({"item_clusters": -1}, "use 0 for the default"),
    ],
)
def test_values_out_of_range_are_refused(given: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        EstimateOptions(**given)

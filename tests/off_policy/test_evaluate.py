"""Options of an estimate."""

import pytest

from ucfrec.errors import InputError
from ucfrec.off_policy.evaluate import EstimateOptions


def test_values_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match=r"discount is 1\.1; it must be a number above 0"):
        EstimateOptions(discount=1.1)
    with pytest.raises(InputError, match="name the least one first"):
        EstimateOptions(reward_range=(2.0, 1.0))

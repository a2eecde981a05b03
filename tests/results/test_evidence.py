"""What evidence shows of a difference, and that nothing doubtful is shown as a number."""

import pytest

from ucfrec.results.evidence import UNMEASURED, Evidence


@pytest.mark.parametrize(
    ("low", "high", "standing"),
    [
        (0.1, 0.3, "better"),
        (-0.3, -0.1, "worse"),
        (-0.1, 0.3, "open"),
        (0.0, 0.0, "level"),
        (None, None, "open"),
    ],
)
def test_the_interval_decides(low: float | None, high: float | None, standing: str) -> None:
    evidence = Evidence(0.0, low, high)
    assert evidence.standing() == standing
    assert evidence.is_reliable == (low is not None)
    doubted = Evidence(0.0, low, high, ("too few users",))
    assert doubted.standing() == "open"
    assert doubted.format() == UNMEASURED.format() == "–"


def test_numbers_stand_with_their_interval() -> None:
    assert Evidence(0.125, -0.5, 1.0).format("+.2f") == "+0.12 [-0.50, +1.00]"

"""Stacked streams compute the features of `UCFPolicy.last_features`."""

import pytest
import torch

from tests.policies.test_ucf import CATALOG, VECTORS, build, random_windows
from ucfrec.episodes.windows import Windows
from ucfrec.policies.ucf import UCFPolicy
from ucfrec.policies.ucf_last_step import FEW, StackedStreams


@pytest.mark.parametrize("sizes", [VECTORS, CATALOG], ids=["vectors", "items"])
@pytest.mark.parametrize("padding", [(0, 0, 0), (0, 2, 5), (5, 4, 3)])
@pytest.mark.parametrize("cropped", [0, 3])
def test_stacked_streams_are_the_streams(
    sizes: dict[str, int], padding: tuple[int, ...], cropped: int
) -> None:
    policy = build("ucf", sizes)
    assert isinstance(policy, UCFPolicy)
    windows = policy.normalized(random_windows(sizes, padding))
    with torch.no_grad():
        expected = policy.last_features(windows)
        found = policy.acting_features()(windows)
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
        # Padding that all windows share can be left out.
        if min(padding) >= cropped:
            short = policy.acting_features()(windows.last(windows.mask.shape[1] - cropped))
            torch.testing.assert_close(short, expected, rtol=1e-5, atol=1e-5)


def test_many_windows_take_the_way_of_training() -> None:
    policy = build("ucf", CATALOG)
    windows = policy.normalized(random_windows(CATALOG))
    many = Windows(*(getattr(windows, name).repeat_interleave(FEW, 0) for name in vars(windows)))
    with torch.no_grad():
        assert torch.equal(policy.acting_features()(many), policy.last_features(many))


def test_a_learner_with_its_own_last_step_keeps_it() -> None:
    class Own(UCFPolicy):
        def last_features(self, windows: Windows) -> torch.Tensor:
            return super().last_features(windows) + 1

    policy = build("ucf", CATALOG)
    assert isinstance(policy.acting_features(), StackedStreams)  # type: ignore[unreachable]
    policy.__class__ = Own
    assert not isinstance(policy.acting_features(), StackedStreams)

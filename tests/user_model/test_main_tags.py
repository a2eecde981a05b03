"""Main tags: the tag that an item is most typical of, and runs of them counted naively."""

from dataclasses import replace

import torch
from hypothesis import given
from hypothesis import strategies as st

from ucfrec.episodes.exposure import Shown
from ucfrec.episodes.states import ItemStates
from ucfrec.user_model.main_tags import MainTags

TAGS = MainTags(torch.tensor([0, 0, 1, 1, 2, -1]), 0.0, 2.0)
steps = st.lists(st.tuples(st.integers(0, 5), st.sampled_from([0.0, 1.0, 1.2, 2.0])), max_size=9)


def shown_of(history: list[tuple[int, float]], reach: int) -> Shown:
    """The last `reach` steps of a session (oldest first), most recent first, padded."""
    recent = [*history[::-1], *[(-1, 0.0)] * reach][:reach]
    return Shown(
        torch.tensor([[item for item, _ in recent]]), torch.tensor([[r for _, r in recent]])
    )


def run_by_hand(history: list[tuple[int, float]]) -> int:
    """Length of the run of one main tag that ends with the last step."""
    tags = [int(TAGS.tags[item]) if reward >= 1.2 else -1 for item, reward in history]
    length = 0
    while length < len(tags) and tags[-1] >= 0 and tags[-1 - length] == tags[-1]:
        length += 1
    return length


@given(steps)
def test_runs_are_those_counted_by_hand(history: list[tuple[int, float]]) -> None:
    reach = 10
    found = TAGS.runs(shown_of(history, reach))[0].tolist()
    for back in range(reach):
        assert found[back] == (run_by_hand(history[: len(history) - back]) if history[back:] else 0)


@given(steps, st.integers(1, 6))
def test_a_tag_tires_after_a_run_of_it(history: list[tuple[int, float]], run: int) -> None:
    expected = int(TAGS.tags[history[-1][0]]) if run_by_hand(history) >= run else -1
    assert TAGS.tired(shown_of(history, 10), run).tolist() == [expected]


def test_what_is_not_remembered_tires_nobody() -> None:
    assert TAGS.tired(shown_of([(0, 2.0)] * 3, 3), 4).tolist() == [-1]


def test_an_item_of_two_tags_has_the_one_whose_items_it_resembles() -> None:
    vectors = torch.tensor([[1.0, 0], [1, 0.1], [0, 1], [0.1, 1], [1, 0.4], [0.4, 1], [1, 1]])
    tags = torch.tensor([[0, -1], [0, -1], [1, -1], [1, -1], [1, 0], [0, 1], [-1, -1]])
    states = replace(ItemStates(vectors, torch.zeros(0, 0), -1.0, 1.0), tags=tags)
    found = MainTags.of(states)
    assert found.tags.tolist() == [0, 0, 1, 1, 0, 1, -1]
    assert found.liked(torch.tensor([-1.0, 0.19, 0.21, 1.0])).tolist() == [False, False, True, True]
    without = MainTags.of(replace(states, tags=torch.zeros(0, 0, dtype=torch.int64)))
    assert without.tags.tolist() == [-1] * 7
    assert without.runs(shown_of([(0, 1.0)] * 4, 4)).tolist() == [[0] * 4]

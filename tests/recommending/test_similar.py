"""Similar items: the cosine of the vectors by which a policy scores items."""

from pathlib import Path

import numpy as np
import pytest

from tests.recommending.test_recommend import SMALL, random_log
from ucfrec import Recommender
from ucfrec.errors import InputError


@pytest.mark.parametrize("kind", ["dt", "item-knn"])
def test_similar_items_are_other_items_by_cosine(kind: str, tmp_path: Path) -> None:
    settings = [*SMALL, "rule.choose=false"] if kind == "dt" else []
    policy = Recommender(kind, settings=settings).fit(random_log(), tmp_path / "run")
    found = policy.recommend_to_items(k=4)
    trained = policy.trained
    vectors = trained.item_states.embeddings.numpy()  # type: ignore[union-attr]
    if kind == "dt":
        vectors = trained.scorer().vectors()[:, :-1]
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    cosines = unit @ unit.T
    np.fill_diagonal(cosines, -np.inf)
    ids = trained.item_ids
    assert ids is not None
    for row, (item, group) in enumerate(found.groupby("item_id", sort=True)):
        assert item == ids[row]
        assert group["rank"].tolist() == [1, 2, 3, 4]
        best = np.sort(cosines[row])[::-1][:4]
        np.testing.assert_allclose(group.score, best, rtol=1e-4)
        assert item not in group.similar_item_id.to_numpy()
    some = policy.recommend_to_items(["7", "3"], k=100)
    assert some.groupby("item_id", sort=False).size().to_dict() == {7: 29, 3: 29}
    with pytest.raises(InputError, match="1 of 2 items are not in the training data, such as 99"):
        policy.recommend_to_items([1, 99])
    with pytest.raises(InputError, match="items is empty"):
        policy.recommend_to_items([])
    with pytest.raises(InputError, match="k is 0"):
        policy.recommend_to_items(k=0)

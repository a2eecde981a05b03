"""The best items of large catalogues, found approximately by faiss."""

from typing import Final

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ucfrec.acting.scorer import Scorer
from ucfrec.episodes.sessions import Sessions
from ucfrec.errors import InputError

_FEWEST: Final = 1_000
"""Items below which one list would hold few of them."""
_SHARE: Final = 16
"""One in so many lists is searched."""
_AT_LEAST: Final = 8
"""Lists that are searched at least."""
_MORE: Final = 256
"""Candidates that are scored beside four times those requested."""
_SAMPLE: Final = 32
"""One in so many sessions is also searched exactly."""


class ItemIndex:
    """Looks for the best items in some lists of similar ones (faiss's IVF), and scores these
    exactly.

    Lists are chosen by the product with the items' vectors. What was shown (repetition, shared
    tags) and what is excluded counts among the candidates found, not in finding them. Sessions of
    which too few candidates are left are scored exactly.
    """

    def __init__(self, scorer: Scorer, kind: str) -> None:
        """
        Args:
            scorer: of a policy of items; its weights must not change afterwards.

        Raises:
            InputError: faiss is not installed, or the rule or the policy need scores of all items.
        """
        try:
            import faiss
        except ModuleNotFoundError:
            raise InputError(
                "the approximate search needs faiss, which is not installed; install ucfrec[faiss]"
            ) from None
        if scorer.rule.draws:
            raise InputError(
                f"the rule draws items ({scorer.rule}), which needs all scores; leave "
                "--approximate out, or give --temperature 0 --explore 0"
            )
        if not scorer.is_product:
            raise InputError(
                f"policies of kind {kind!r} score items in a way of their own under this rule; "
                "leave --approximate out"
            )
        self._scorer, self._rng = scorer, np.random.default_rng(0)
        vectors = scorer.vectors()
        size = vectors.shape[1]
        lists = max(1, round(len(vectors) ** 0.5)) if len(vectors) >= _FEWEST else 1
        faiss.omp_set_num_threads(torch.get_num_threads())
        self._index = faiss.IndexIVFFlat(
            faiss.IndexFlatIP(size), size, lists, faiss.METRIC_INNER_PRODUCT
        )
        self._index.cp.seed = 0
        self._index.nprobe = max(_AT_LEAST, lists // _SHARE)
        self._index.train(vectors)
        self._index.add(vectors)
        self.found = self.wanted = 0
        """Of the best items of the sampled sessions: those found, and all."""
        self.sampled = 0
        """Sessions that were also searched exactly."""

    def best(
        self,
        sessions: Sessions,
        left_out: tuple[Tensor, Tensor],
        excluded: Tensor | None,
        k: int,
    ) -> tuple[Tensor, Tensor]:
        """`k` items (B, k), best first, and their scores (B, k) less that of the best, nats; −∞
        where fewer are left.

        Args:
            sessions: B sessions; see `Scorer.scores`.
            left_out: rows (N,) and items (N,) of what may not be recommended.
            excluded: (n_items,) bool, what no user is recommended.
            k: at most the number of items.
        """
        items, scores = self._candidates(sessions, left_out, excluded, k)
        short = torch.isneginf(scores[:, -1])
        batch = len(short)
        sampled = torch.zeros(batch, dtype=torch.bool)
        sampled[self._rng.choice(batch, size=-(-batch // _SAMPLE), replace=False)] = True
        exactly = torch.nonzero(short | sampled)[:, 0]
        for row in exactly.tolist():
            of_row = torch.tensor([row])
            items_out = left_out[1][left_out[0] == row]
            row_out = torch.zeros_like(items_out), items_out
            scores_of_row = self._scorer.scores(sessions.at(of_row), row_out, excluded, empty=True)
            exact = scores_of_row.topk(k)
            if sampled[row]:
                self._compare(items[row], scores[row], exact.indices[0], exact.values[0])
            if short[row]:
                items[row], scores[row] = exact.indices[0], exact.values[0]
        highest = scores[:, :1].masked_fill(torch.isneginf(scores[:, :1]), 0.0)
        return items, scores - highest

    def _compare(self, items: Tensor, scores: Tensor, exact: Tensor, values: Tensor) -> None:
        if torch.isneginf(scores[-1]):
            # The exact search answers it.
            items = exact
        best = exact[~torch.isneginf(values)]
        self.found += int(torch.isin(best, items).sum())
        self.wanted += len(best)
        self.sampled += 1

    def _candidates(
        self,
        sessions: Sessions,
        left_out: tuple[Tensor, Tensor],
        excluded: Tensor | None,
        k: int,
    ) -> tuple[Tensor, Tensor]:
        """The best k of the candidates and their scores, (B, k) each."""
        scorer, n_items = self._scorer, self._index.ntotal
        query = scorer.query(sessions)
        part, count = scorer.weigh(query), min(n_items, 4 * k + _MORE)
        factors = F.pad(part.factors, (0, 1), value=1.0).numpy()
        products, numbers = self._index.search(factors, count)
        items, missing = torch.from_numpy(numbers), torch.from_numpy(numbers < 0)
        items = items.clamp(min=0)
        scores = scorer.scores_of_some(query, part, items, torch.from_numpy(products))
        if excluded is not None:
            missing |= excluded[items]
        # Pairs of a row and an item are single numbers.
        rows = torch.arange(len(items)).unsqueeze(1) * n_items
        missing |= torch.isin(rows + items, left_out[0] * n_items + left_out[1])
        best = scores.masked_fill(missing, -torch.inf).topk(k)
        return items.gather(1, best.indices), best.values

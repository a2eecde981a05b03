"""Expected reward of every item of a catalogue: additive effects of items, users and the state."""

from collections.abc import Callable, Mapping
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ucfrec.episodes.exposure import Likeness
from ucfrec.episodes.offers import Offer
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import Shown
from ucfrec.user_model.interest import Interests, ShownTastes, sum_before
from ucfrec.user_model.running import AGES, RunningRates, TimeBins

MEMORY = 50
"""Steps of a session that show tastes, the latest ones."""
_LEAST = 1e-6
"""Variance of tastes in every direction, relative to the mean."""
FITTED = "item_reward.safetensors"
"""File of a fitted model in its folder."""
LAGS = 10
"""Items shown before a step whose repetition and likeness enter its expected reward."""
PLACES = 15
"""Places of a list after the first that have an effect of their own; later ones are like the last.
Also the items of a list whose likeness to those below them counts."""
_AT_ONCE = 8192
"""Items that are compared to what was shown before them at once."""
CLIP = 5.0
"""Standardised states beyond this many standard deviations are clipped."""


class UserPosterior(ShownTastes):
    """Tastes of the users of B sessions, from what was shown to them, and its rewards.

    Tastes v = (level, affinity) add v · (1, e_i) to the score of an item with the vector e_i, and
    are drawn from N(0, C), where C is how training users differ. A step shows v · (1, e_i) plus
    noise: its reward less what the item usually gets. Tastes are their posterior mean, a ridge
    regression within the session (Rasmussen and Williams, 2006, Gaussian Processes, section 2.1).
    """

    def __init__(self, items: int, embedding_size: int) -> None:
        super().__init__()
        size = embedding_size + 1
        self.root = nn.Buffer(torch.zeros(size, size))
        """L with L Lᵀ = C, in units of the standard deviation of the noise."""
        self.usual = nn.Buffer(torch.zeros(items))
        """The reward of every item with a user without tastes of their own, as `targets`."""

    def forward(
        self,
        items: Tensor,
        vectors: Tensor,
        targets: Tensor,
    ) -> Tensor:
        """Posterior means (B, D + 1) of level and affinity, times `weights`, from the items (B, N)
        that were shown, in any order, −1 for none, the vectors (n_items, D) of all items, and what
        those shown earned (B, N), as `ItemRewardModel.target`."""
        valid, items = items >= 0, items.clamp(min=0)
        inputs = F.pad(vectors[items], (1, 0), value=1.0) @ self.root * valid.unsqueeze(2)
        unusual = (targets - self.usual[items]) * valid
        matrix = inputs.mT @ inputs + torch.eye(len(self.root), device=inputs.device)
        solution = _solution(matrix, inputs.mT @ unusual.unsqueeze(2)).squeeze(2)
        return self.weights * (solution @ self.root.T)


def _solution(matrix: Tensor, right: Tensor) -> Tensor:
    """(B, K, 1) solutions of symmetric equations (B, K, K) with eigenvalues of at least 1."""
    if not torch.compiler.is_exporting():
        # Of weights that are NaN the solution is, too, which the decision then says.
        return torch.cholesky_solve(right, torch.linalg.cholesky_ex(matrix).L)
    # ONNX has no factorisation: Gauss-Jordan elimination, which needs no pivots here.
    size = matrix.shape[1]
    system, units = torch.cat([matrix, right], 2), torch.eye(size).unsqueeze(2)
    for k in range(size):
        row = system[:, k : k + 1] / system[:, k : k + 1, k : k + 1]
        system = system - (system[:, :, k : k + 1] - units[k]) * row
    return system[:, :, size:]


def compare_to_history(likeness: Likeness, history: Tensor, items: Tensor) -> Tensor:
    """Likeness (M, L) of items (M,) to each of those shown before them, (M, L), −1 for none."""
    parts = []
    batches = zip(torch.split(history, _AT_ONCE), torch.split(items, _AT_ONCE), strict=True)
    for earlier, later in batches:
        profiles = likeness.profile(earlier.reshape(-1, 1), torch.ones(earlier.numel(), 1))
        later_items = later.repeat_interleave(history.shape[1]).unsqueeze(1)
        parts.append(likeness.to_items(profiles, later_items).view(earlier.shape))
    return torch.cat(parts)


def list_inputs(likeness: Likeness, above: Tensor, items: Tensor) -> tuple[Tensor, Tensor]:
    """What the effects of lists multiply, for items (M,) below others (M, P), −1 for none: which
    place it is, (M, `PLACES`), and the summed likeness to these, (M, 1)."""
    place = (above >= 0).sum(1).clamp(max=PLACES)
    alike = compare_to_history(likeness, above[:, :PLACES], items).sum(1, keepdim=True)
    return F.one_hot(place, PLACES + 1)[:, 1:].float(), alike


def root_of_tastes(tastes: Tensor, vectors: Tensor) -> Tensor:
    """L (D, D) with L Lᵀ ∝ C, the covariance around 0 of the tastes (U, D) of training users,
    shrunk where they are few (Ledoit and Wolf, 2004), such that they add 1 to the variance of
    scores of logged items with the vectors (M, D)."""
    from sklearn.covariance import ledoit_wolf

    covariance = torch.from_numpy(ledoit_wolf(tastes.double().numpy(), assume_centered=True)[0])
    inputs = vectors.double()
    variance = ((inputs @ covariance) * inputs).sum(1).mean()
    least = _LEAST * covariance.trace() / len(covariance) * torch.eye(len(covariance))
    root: Tensor = torch.linalg.cholesky((covariance + least) / variance)
    return root.float()


class ItemRewardModel(nn.Module):
    """A generalised additive model of the reward of showing item i to user u in state s.

    The linear predictor is

        η = item_i + user_u + state · x + (affinity_u + interactionᵀ x) · e_i + exposure_i + list_i,

    x being the standardised state, e_i the centred embedding of the item, and exposure_i what
    repeating an item, or showing one like it, n steps after the last time adds (`Likeness`). list_i
    is 0 at the top of a list; below, it is the effect of the place, and of the likeness to the
    items above, summed: `scores` are of the top, so that places change no choice. What the user was
    shown until the decision adds to user_u and affinity_u (`Interests`); for new users, these are
    what the session shows (`UserPosterior`). Item effects include those of tags and embeddings, as
    of new items. η is the log-odds of the higher of two rewards, otherwise the standardised reward.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        """Of `state` size S, `action` size D, that of an item's embedding, and numbers of `items`,
        of `users` whose effects it has, of those `followed`, and of `tags` of one item at most."""
        super().__init__()
        state, dim, items = sizes["state"], sizes["action"], sizes["items"]
        users = sizes.get("users", 0) + 1  # the last row is that of unknown users
        self.lags = LAGS
        self.binary = nn.Buffer(torch.zeros((), dtype=torch.bool))
        self.reward_low = nn.Buffer(torch.zeros(()))
        self.reward_mean = nn.Buffer(torch.zeros(()))
        self.state_mean = nn.Buffer(torch.zeros(state))
        self.vectors = nn.Buffer(torch.zeros(items, dim))
        self.item = nn.Buffer(torch.zeros(items))
        self.user = nn.Buffer(torch.zeros(users))
        self.affinity = nn.Buffer(torch.zeros(users, dim))
        self.state = nn.Buffer(torch.zeros(state))
        self.interaction = nn.Buffer(torch.zeros(state, dim))
        self.exposure = nn.Buffer(torch.zeros(4, LAGS))
        self.reward_high = nn.Buffer(torch.ones(()))
        self.reward_std = nn.Buffer(torch.ones(()))
        self.state_std = nn.Buffer(torch.ones(state))
        # Where items come and go: the effects of what they earned until a time, and of their age.
        self.running = nn.Buffer(torch.zeros(sizes.get("running", 0)))
        self.latest = nn.Buffer(torch.zeros(max(0, len(self.running) - AGES), items))
        self.rates: RunningRates | None = None
        """As of every time of a store; None for the `latest`."""
        self.position = nn.Buffer(torch.zeros(PLACES))
        self.above = nn.Buffer(torch.zeros(1))
        self.likeness = Likeness(items, dim, sizes.get("tags", 0))
        self.tastes = UserPosterior(items, dim)
        self.interests = Interests(sizes.get("followed", users), items, dim)
        self.user_rows: EpisodeStore | None = None
        """Of a store, until every decision; None for those of training and the session."""

    @property
    def reach(self) -> int:
        """Items shown before a step that its expected reward depends on."""
        reads_more = self.tastes.are_known or self.interests.are_known
        return max(self.lags, MEMORY) if reads_more else self.lags

    def sum_running(self, offer: Offer | None, items: Tensor | None = None) -> Tensor:
        """What the running rates and ages add at M decisions: (M,) of one item (M,) each, or
        (M, n_items); 0 where items are always available."""
        if offer is None or not len(self.running):
            return torch.zeros(())
        rates = self.rates or RunningRates(TimeBins(0, 1, 0), self.latest.unsqueeze(0))
        if items is None:
            return rates.sum_all(offer, self.running)
        return rates.inputs(offer, items) @ self.running

    def scores(
        self,
        states: Tensor,
        history: Shown,
        users: Tensor | None = None,
    ) -> Tensor:
        """Linear predictors of all items, (B, n_items): log-odds of the higher reward if there are
        two, otherwise rewards in standard deviations from their mean.

        Args:
            states: (B, S) before the step.
            history: what the sessions showed before it; more than `reach` items have no effect.
            users: (B,) int64 numbers in the training store, −1 if unknown; None if all are.
        """
        items, repeated, alike = self.exposures(history)
        tastes = self.tastes_after(history, users)
        scores = self.item + self.query(states, users, tastes) @ self.vectors.T
        scores = self.likeness.added_to(scores, self.likeness.profile(items, alike))
        rows, lags = torch.nonzero(items >= 0, as_tuple=True)
        scores = scores.index_put((rows, items[rows, lags]), repeated[rows, lags], accumulate=True)
        return scores + self.level(states, users, tastes).unsqueeze(1)

    def score(
        self,
        states: Tensor,
        history: Shown,
        users: Tensor | None,
        items: Tensor,
        offer: Offer | None = None,
        above: Tensor | None = None,
        sums: Tensor | None = None,
    ) -> Tensor:
        """Linear predictors (B,) of one item each, int64 (B,), at the times of `offer`, below
        items (B, P) of the same list, −1 for none; see `scores` and `tastes_after`."""
        x = self.standardise(states)
        added = ((x @ self.interaction) * self.vectors[items]).sum(1)
        added = added + self.sum_running(offer, items)
        if above is not None:
            position, alike = list_inputs(self.likeness, above, items)
            added = added + position @ self.position + alike @ self.above
        earlier, repeated, alike = self.exposures(history)
        column, user_rows = items.unsqueeze(1), self._user_rows(users, items)
        exposure = self.likeness.to_items(self.likeness.profile(earlier, alike), column)
        exposure = exposure + ((earlier == column) * repeated).sum(1)
        tastes = self.tastes_after(history, users, sums)
        affinity = ((self.affinity[user_rows] + tastes[:, 1:]) * self.vectors[items]).sum(1)
        fixed = self.item[items] + self.user[user_rows] + tastes[:, 0] + affinity + exposure
        return fixed + x @ self.state + added

    def level(
        self,
        states: Tensor,
        users: Tensor | None,
        tastes: Tensor,
    ) -> Tensor:
        """Part (B,) of the scores that all items share: of states (B, S), users (B,) and their
        `tastes_after` (B, D + 1)."""
        of_user = self.user[self._user_rows(users, states)] + tastes[:, 0]
        return of_user + self.standardise(states) @ self.state

    def query(
        self,
        states: Tensor,
        users: Tensor | None,
        tastes: Tensor,
    ) -> Tensor:
        """What multiplies the vector of every item, (B, D); the arguments are those of `level`."""
        interaction = self.standardise(states) @ self.interaction
        return self.affinity[self._user_rows(users, states)] + tastes[:, 1:] + interaction

    def tastes_after(
        self,
        history: Shown,
        users: Tensor | None,
        sums: Tensor | None = None,
    ) -> Tensor:
        """Level and affinity (B, D + 1) that sessions, and earlier rows of their users (B,), show;
        `sums` (B, D + 2) of `sums_before` take the place of both."""
        items, rewards = history.latest(MEMORY)
        if self.tastes.are_known:
            return cast("Tensor", self.tastes(items, self.vectors, self.target(rewards)))
        if not self.interests.are_known:
            # The length of a tensor would be that of one batch in a graph that is exported.
            size = history.items.shape[0], self.vectors.shape[1] + 1
            return torch.zeros(size, device=self.item.device)
        if sums is None:
            in_training = self.interests.sums[self._user_rows(users, items)]
            sums = in_training + self.sum_rows(items, self.target(rewards))
        return self.interests.rates(sums) * self.interests.weights

    def sum_rows(self, items: Tensor, targets: Tensor) -> Tensor:
        """See `Interests.sum_rows`."""
        return self.interests.sum_rows(items, targets, self.vectors, self.binary)

    def sums_before(self, users: Tensor, times: Tensor) -> Tensor:
        """(M, D + 2) what interests of users (M,) before times (M,) come from, in `user_rows`."""
        assert self.user_rows is not None
        return sum_before(self.user_rows, users, times, self.target, self.sum_rows)

    def expect(self, scores: Tensor) -> Tensor:
        """Expected rewards, in reward units, of linear predictors of any shape."""
        origin = torch.where(self.binary, self.reward_low, self.reward_mean)
        scale = torch.where(self.binary, self.reward_high - self.reward_low, self.reward_std)
        return origin + scale * torch.where(self.binary, torch.sigmoid(scores), scores)

    @torch.no_grad()
    def set_effects(
        self,
        effects: Mapping[str, Tensor],
        sum_content: Callable[[Tensor], Tensor],
    ) -> None:
        """Set the fitted effects, those of `EFFECTS` by name; missing ones become 0, and effects of
        content those (n_items,) of the items' tags and embeddings."""
        of_rows = ("state", "interaction", "exposure", "running", "position", "above")
        for name in ("user", "affinity", *of_rows):
            buffer = self.get_buffer(name)
            buffer.copy_(effects.get(name, torch.zeros(buffer.shape)).view(buffer.shape))
        if "context" in effects:
            self.interaction[-len(effects["context"]) :] += effects["context"]
        self.item.copy_(effects["mean"] + effects.get("item", torch.zeros(())))
        if "content" in effects:
            self.item.add_(sum_content(effects["content"]))
        self.tastes.weigh(effects.get("tastes", torch.zeros(())))
        self.interests.weigh(effects.get("interest", torch.zeros(())))
        self.eval()

    def target(self, rewards: Tensor) -> Tensor:
        """What η predicts: whether rewards (...) are the higher one, or standardised rewards."""
        standardised = ((rewards - self.reward_mean) / self.reward_std).clamp(-CLIP, CLIP)
        return torch.where(self.binary, (rewards == self.reward_high).float(), standardised)

    def standardise(self, states: Tensor) -> Tensor:
        """States (..., S) in standard deviations from their training mean, clipped."""
        return (states - self.state_mean).div_(self.state_std).clamp_(-CLIP, CLIP)

    def scale_rewards(self, rewards: Tensor) -> Tensor:
        """Rewards (...) on a scale from 0 to 1."""
        return ((rewards - self.reward_low) / (self.reward_high - self.reward_low)).clamp(0, 1)

    def exposures(self, history: Shown) -> tuple[Tensor, Tensor, Tensor]:
        """Items (B, lags) shown before, and the weights (B, lags) of repetition and likeness."""
        items, rewards = history.padded(self.lags)
        liked = self.scale_rewards(rewards)
        repeated, alike, repeated_liked, alike_liked = self.exposure
        return items, repeated + repeated_liked * liked, alike + alike_liked * liked

    def _user_rows(self, users: Tensor | None, batch: Tensor) -> Tensor:
        """Rows (B,) of the users in the effects of users, B being the length of `batch`."""
        last = len(self.user) - 1
        if users is None:
            return torch.full(batch.shape[:1], last, device=batch.device)
        return torch.where((users >= 0) & (users < last), users, last)

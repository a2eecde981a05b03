"""CQL whose conservative term is clipped from below, as CORL's for AntMaze; needs d3rlpy."""

from typing import Any

import torch
from d3rlpy.algos import CQL, CQLConfig
from d3rlpy.algos.qlearning.torch.cql_impl import CQLImpl
from torch import Tensor


class ClippedCQL(CQL):  # type: ignore[misc]
    """d3rlpy's CQL with the loss of `ClippedCQLImpl`."""

    _impl: Any

    def __init__(self, config: CQLConfig, device: str, lowest: float) -> None:
        """Args:
        config: settings of CQL.
        device: as d3rlpy names it.
        lowest: least value of a step's conservative term, in units of the return.
        """
        super().__init__(config, device, False)
        self._lowest = lowest

    def inner_create_impl(self, observation_shape: Any, action_size: int) -> None:
        """Make the networks, as CQL does."""
        super().inner_create_impl(observation_shape, action_size)
        impl, config = self._impl, self._config
        self._impl = ClippedCQLImpl(
            observation_shape=observation_shape,
            action_size=action_size,
            modules=impl.modules,
            q_func_forwarder=impl._q_func_forwarder,
            targ_q_func_forwarder=impl._targ_q_func_forwarder,
            gamma=config.gamma,
            tau=config.tau,
            alpha_threshold=config.alpha_threshold,
            conservative_weight=config.conservative_weight,
            n_action_samples=config.n_action_samples,
            soft_q_backup=config.soft_q_backup,
            max_q_backup=config.max_q_backup,
            compiled=self.compiled,
            device=self._device,
        )
        self._impl.lowest = self._lowest


class ClippedCQLImpl(CQLImpl):  # type: ignore[misc]
    """Clips log Σ exp Q(s, ·) − Q(s, a) of each step at `lowest`, before the mean is taken."""

    lowest: float

    def _compute_conservative_loss(
        self, obs_t: Tensor, act_t: Tensor, obs_tp1: Tensor, returns_to_go: Tensor
    ) -> Tensor:
        values = []
        for observations in (obs_t, obs_tp1):
            sampled, densities = self._compute_policy_is_values(
                policy_obs=observations, value_obs=obs_t, returns_to_go=returns_to_go
            )
            values.append(sampled - densities)
        uniform, density = self._compute_random_is_values(obs_t)
        soft_maximum = torch.cat([*values, uniform - density], dim=2).logsumexp(2, keepdim=True)
        logged = self._q_func_forwarder.compute_expected_q(obs_t, act_t, "none")
        gap: Tensor = (soft_maximum - logged).clamp(min=self.lowest).mean(dim=(1, 2))
        weighted: Tensor = self._conservative_weight * (gap - self._alpha_threshold)
        return weighted

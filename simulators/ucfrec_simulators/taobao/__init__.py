"""Environments of ranked result pages: VirtualTaobao and the synthetic SyntheticTaobao."""

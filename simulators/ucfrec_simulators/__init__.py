"""Simulators of sessions: Gymnasium vector environments and their built-in behavior policies."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ucfrec_simulators.taobao.virtual import VirtualTaobao

__all__ = ["VirtualTaobao"]


def __getattr__(name: str) -> Any:
    # The package is imported by every command that lists simulators; torch takes a second.
    if name == "VirtualTaobao":
        from ucfrec_simulators.taobao.virtual import VirtualTaobao

        return VirtualTaobao
    raise AttributeError(f"module 'ucfrec_simulators' has no attribute {name!r}")

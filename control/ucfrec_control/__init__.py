"""Offline control (one's own robots, D4RL, AntMaze) with the policies of ucfrec."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ucfrec_control.training.policy import ControlPolicy

__all__ = ["ControlPolicy"]


def __getattr__(name: str) -> Any:
    # Lazy, because importing torch takes a second and `ucfrec-control --help` does not need it.
    if name == "ControlPolicy":
        from ucfrec_control.training.policy import ControlPolicy

        return ControlPolicy
    raise AttributeError(f"module 'ucfrec_control' has no attribute {name!r}")

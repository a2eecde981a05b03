"""Model selection by the return of validation episodes (paper, Appendix G.3)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from ucfrec.fitting.checkpoint import load_tensors, save_tensors
from ucfrec.fitting.loop import Callbacks
from ucfrec.runs.trained_policy import TrainedPolicy
from ucfrec_control.training.evaluate import RETURN, choose_rule, play

_SEED: Final = 500_000
"""Of the validation episodes, which are others than those that are reported."""


def select_by_return(run: Path, env_id: str, episodes: int) -> Callbacks:
    """What keeps the weights of the validation with the highest mean return of `episodes`, at the
    preset's first target, as the checkpoint `return` of a run that is trained; a resumed training
    goes on from the best so far."""
    path = run / "policy" / f"{RETURN}.safetensors"

    def on_validation(step: int, logged: Mapping[str, float]) -> None:
        trained = TrainedPolicy.load(run, "last", in_training=True)
        rule = choose_rule(trained, env_id=env_id)
        mean = float(play(trained, env_id, rule, episodes, _SEED).returns.mean())
        if not path.exists() or mean > load_tensors(path)[1]["return"]:
            save_tensors(path, trained.policy.state_dict(), {"step": step, "return": mean})

    return Callbacks(on_validation=on_validation)

"""Files of tensors of two runs are compared, to the last bit."""

from pathlib import Path

import torch

from ucfrec.fitting.checkpoint import load_tensors


def assert_same_tensors(found: Path, expected: Path, *names: str) -> None:
    for name in names:
        files = (run / f"{name}.safetensors" for run in (found, expected))
        tensors, others = (load_tensors(file)[0] for file in files)
        assert tensors.keys() == others.keys()
        assert all(torch.equal(each, others[key]) for key, each in tensors.items()), name

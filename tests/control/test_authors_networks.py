"""DT, DC and LSDT answer as their authors' code does, with its weights: `fixtures/`, written by
`tests/control/fixtures/authors_networks.py`, which says of which commits."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from ucfrec.episodes.windows import Windows
from ucfrec.policies.base import PolicyConfig, SequencePolicy
from ucfrec.policies.convformers import DCConfig, DCPolicy, LSDTConfig, LSDTPolicy
from ucfrec.policies.dt import DTConfig, DTPolicy

FIXTURES = Path(__file__).parent / "fixtures"
SIZES = {"state": 5, "action": 3, "items": 0}
WIDTH, LAYERS, STEPS, TABLE = 16, 2, 6, 40
SHAPE = {"context": STEPS, "dim": WIDTH, "layers": LAYERS, "max_timestep": TABLE}
POLICIES: dict[str, tuple[type[SequencePolicy], PolicyConfig]] = {
    "dt": (DTPolicy, DTConfig(**SHAPE, heads=2)),
    "dc": (DCPolicy, DCConfig(**SHAPE)),
    "lsdt": (LSDTPolicy, LSDTConfig(**SHAPE, heads=2, kernel_groups=2)),
}


def named(text: str) -> dict[str, str]:
    """Our name of a layer by the authors' name of it."""
    return dict(pair.split("=") for pair in text.split())


SHARED = named(
    "embed_timestep=embed.embed_timestep embed_return=embed.embed_return "
    "embed_rtg=embed.embed_return embed_state=embed.embed_state embed_action=head.embed_action "
    "embed_ln=embed.norm predict_action.0=head.out transformer.ln_f=final_norm"
)
BLOCKS = {
    "dt": """ln_1=attention_norm attn.c_attn=query_key_value attn.c_proj=out ln_2=mlp_norm
        mlp.c_fc=mlp.0 mlp.c_proj=mlp.2""",
    "dc": """ln_1=mixer_norm conv.rtg_conv1d=mixers.0 conv.obs_conv1d=mixers.1
        conv.act_conv1d=mixers.2 ln_2=mlp_norm mlp.0=mlp.0 mlp.2=mlp.2""",
    "lsdt": """attention.fmlp.0=squeeze attention.fl1=gates.0 attention.fl2=gates.1
        attention.proj_net=out attention.Dynamicconv_layer.linear1=short.gated ln1=norm
        attention.Dynamicconv_layer.linear2=short.out mlp.0=mlp.0 mlp.2=mlp.2 ln2=mlp_norm""",
}
UNUSED = ("transformer.wte", "predict_return", "predict_rtg", "predict_state")


def renamed(policy_name: str, weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The authors' weights by our names."""
    found, left, names = {}, dict(weights), named(BLOCKS[policy_name])
    for name in weights:
        layer, _, field = name.rpartition(".")
        if layer.startswith(UNUSED):
            del left[name]
        elif layer in SHARED:
            found[f"{SHARED[layer]}.{field}"] = left.pop(name)
        else:
            block, inner = layer.removeprefix("transformer.").removeprefix("h.").split(".", 1)
            if inner in names:
                # The layers of DT's blocks keep their weights transposed.
                transposed = policy_name == "dt" and weights[name].ndim == 2
                value = left.pop(name)
                ours = f"blocks.{block}.{names[inner]}.{field}"
                found[ours] = value.T.contiguous() if transposed else value
    for block in range(LAYERS) if policy_name == "lsdt" else ():
        found |= long_and_short(left, f"transformer.{block}.attention.", f"blocks.{block}.")
    assert not left, "weights of the authors that have no name of ours"
    return found


def long_and_short(left: dict[str, Tensor], theirs: str, ours: str) -> dict[str, Tensor]:
    """LSDT's attention and kernels by our names; takes them from `left`."""
    found = {}
    for field in ("weight", "bias"):
        parts = [left.pop(f"{theirs}{part}_net.{field}") for part in "qkv"]
        found[f"{ours}long.query_key_value.{field}"] = torch.cat(parts)
        # Of eleven taps the sixth is the own token's, and later ones are masked.
        taps = left.pop(f"{theirs}Dynamicconv_layer.linear_weight.{field}").unflatten(0, (-1, 11))
        found[f"{ours}short.taps.{field}"] = taps[:, :6].flatten(0, 1)
    found[f"{ours}short.bias"] = left.pop(f"{theirs}Dynamicconv_layer.bias")
    return found


def windows_of(inputs: dict[str, Tensor]) -> Windows:
    mask = inputs.pop("mask").bool()
    inputs["returns_to_go"] = inputs["returns_to_go"].squeeze(-1)
    return Windows(**inputs, rewards=torch.zeros(mask.shape), mask=mask)


@pytest.mark.parametrize("policy_name", POLICIES)
def test_outputs_equal_those_of_the_authors_code(policy_name: str) -> None:
    fixture = load_file(FIXTURES / f"{policy_name}.safetensors")
    theirs, inputs = (
        {k.removeprefix(part): v for k, v in fixture.items() if k.startswith(part)}
        for part in ("weight.", "input.")
    )
    kind, config = POLICIES[policy_name]
    policy = kind(config, SIZES).eval()
    buffers = {name for name, _ in policy.named_buffers()}
    weights = renamed(policy_name, theirs)
    assert weights.keys() == policy.state_dict().keys() - buffers
    policy.load_state_dict(weights, strict=False)
    windows = windows_of(inputs)
    assert bool(windows.mask.all()) == (policy_name != "dt")
    with torch.no_grad():
        actions = policy.head.predict(policy.features(windows))
    ours, expected = actions[windows.mask], fixture["actions"][windows.mask]
    torch.testing.assert_close(ours, expected, atol=2e-6, rtol=0)

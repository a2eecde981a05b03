"""Figures show what the stored numbers say, and name what is missing."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.support.control_files import TINY, control, set_options, write_made
from tests.support.result_rows import result_row
from ucfrec.episodes.store import EpisodeStore
from ucfrec.episodes.windows import AugmentedEpisodes
from ucfrec.files.atomic import read_json
from ucfrec.results.rows import append_rows
from ucfrec_control.benchmark.robustness import drops
from ucfrec_control.figures import diagnostics, plots
from ucfrec_control.figures.figures import HIGHS, LOWS, NEEDS, make_figures

KINDS = ("tangent", "faithful")
EDITS = ("crm.epochs=3", "csg.epochs=2", "csg.lambda_band=1.0", "augment.epsilon_r=1.0")
EDITS += ("augment.copies=1",)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of UCF with each generator."""
    folder = tmp_path_factory.mktemp("figures")
    store = folder / "store"
    control("prepare", write_made(folder), "--out", store)
    for kind in KINDS:
        settings = set_options((*TINY, *EDITS, f"csg.kind={kind}"))
        control("train", store, "--out", folder / "runs" / kind, *settings)
    return folder / "runs"


def heights(axes: object) -> dict[tuple[int, str], float]:
    """Of bars, by the number of their group and their kind."""
    return {
        (round(bar.get_x() + bar.get_width() / 2), container.get_label()): bar.get_height()
        for container in axes.containers  # type: ignore[attr-defined]
        if hasattr(container, "patches")
        for bar in container.patches
    }


def first_spread(axes: Any, along: int) -> float:
    (spread, *_) = (c.errorbar[2][0] for c in axes.containers if getattr(c, "errorbar", None))
    return float(np.diff(spread.get_segments()[0][:, along])[0] / 2)


def test_bars_are_as_high_as_the_drops_of_their_rows() -> None:
    of = {"metric": "score", "task": "d", "metrics": {"score_at_one": 0.0}}
    rows = [
        result_row(
            50.0 - 7 * i * j - s, method=m, training_seed=s, conditions={"distractor": k}, **of
        )
        for i, m in enumerate(("dt", "ucf", "ucf-screened"))
        for j, k in enumerate(("none", "deterministic", "early"))
        for s in range(3)
    ]
    lost = drops(rows)
    (axes,) = plots.robustness_bars(lost, "drop", "loss (%)").axes
    drawn = heights(axes)
    assert len(drawn) == 6
    for (group, kind), height in drawn.items():
        method = ("dt", "ucf", "ucf-screened")[group]
        own = [r["drop"] for r in lost if (r["method"], r["distractor"]) == (method, kind)]
        assert height == pytest.approx(sum(own) / 3)
    first = [r["drop"] for r in lost if (r["method"], r["distractor"]) == ("dt", "deterministic")]
    assert first_spread(axes, 1) == pytest.approx(np.std(first, ddof=1))


def test_a_panel_has_the_mean_scores_of_its_dataset() -> None:
    rows = [
        result_row(score + 2 * seed, metric="score", task=task, method=method, training_seed=seed)
        for task, method, score in (("a", "dt", 10.0), ("a", "ucf", 30.0), ("b", "ucf", 50.0))
        for seed in range(2)
    ]
    first, second = plots.score_panels([row.as_line() for row in rows]).axes
    drawn = [
        {round(bar.get_y() + bar.get_height() / 2): bar.get_width() for bar in axes.patches}
        for axes in (first, second)
    ]
    assert drawn == [{0: 11.0, 1: 31.0}, {1: 51.0}]
    assert first_spread(first, 0) == pytest.approx(1.0)  # of two seeds 2 apart


@pytest.mark.parametrize("kind", KINDS)
def test_a_cell_of_the_heatmap_is_the_share_that_passes_both_gates(runs: Path, kind: str) -> None:
    editing = diagnostics.Editing.of(runs / kind)
    shares = diagnostics.acceptance_grid(runs / kind, LOWS, HIGHS)
    (axes, _) = plots.acceptance_heatmap(LOWS, HIGHS, shares, (0.2, 0.5)).axes
    low, high = LOWS.index(0.2), HIGHS.index(0.5)
    cell = axes.images[0].get_array()[low, high]
    crm, steps = editing.crm, editing.factual
    z = crm.abduct(steps.states, steps.actions, steps.rewards)
    random = torch.Generator().manual_seed(0)
    proposed = editing.generator.propose(steps, z, random)
    lengths = ((proposed - steps.states) / crm.state_std).square().sum(1).sqrt().numpy()
    off = (crm.predict(proposed, steps.actions, z) - steps.rewards).abs().numpy()
    within = (lengths >= 0.2 - 1e-5) & (lengths <= 0.5 + 1e-5)
    passed = 100 * (within & (off <= editing.epsilon_r)).mean()
    assert 5 < passed < 100
    assert cell == pytest.approx(passed)
    np.testing.assert_array_equal(np.isnan(shares), np.greater_equal.outer(LOWS, HIGHS))


def test_the_histogram_counts_the_moves_of_the_copies(runs: Path) -> None:
    run = runs / "tangent"
    store = EpisodeStore.open(runs.parent / "store")
    copies = AugmentedEpisodes.load(run / "augmented.safetensors")
    at = copies.copy_source[copies.edit_copy], copies.edit_step
    factual = store.windows(*at, 1).states[:, 0]
    std = store.split("train").state_statistics[1]
    lengths = ((torch.from_numpy(copies.edit_state) - factual) / std).norm(dim=1).numpy()
    edges, counts, band = diagnostics.move_histogram(run)
    assert band == (0.2, 0.5)
    (axes,) = plots.move_histogram(edges, counts, band).axes
    shares = np.array([bar.get_height() for bar in axes.patches])
    expected = 100 * np.histogram(lengths, np.asarray(edges) + 1e-6)[0] / len(lengths)
    assert shares.sum() == pytest.approx(100)
    # A move at an edge may round into the next bin.
    assert np.abs(shares - expected).max() <= 2 * 100 / len(lengths)
    # The overlay of the edits shows the widest direction first.
    factual, edited = diagnostics.edit_states(run)
    assert 0.19 < np.linalg.norm(edited - factual, axis=1).mean() < 0.5
    (axes,) = plots.state_overlay(factual, edited).axes
    points = np.asarray(axes.collections[0].get_offsets())
    widest = np.linalg.eigvalsh(np.cov(factual.T))[::-1]
    np.testing.assert_allclose(points.var(axis=0, ddof=1), widest[:2], rtol=1e-6)


def test_rows_of_the_attention_map_sum_to_one_and_see_no_future(runs: Path) -> None:
    weights = diagnostics.attention(runs / "tangent")
    assert weights.shape == (5, 3, 5)
    np.testing.assert_allclose(weights.sum(axis=(1, 2)), 1, atol=1e-5)
    later = np.triu(np.ones((5, 5), dtype=bool), 1)
    for modality, also_now in ((0, False), (1, False), (2, True)):
        unseen = later | (np.eye(5, dtype=bool) & also_now)
        assert (weights[:, modality][unseen] == 0).all()
        assert (weights[:, modality][~unseen] > 0).all()


def test_curves_are_means_over_seeds() -> None:
    names = ("task", "lambda_mask", "training_seed", "score")
    points = [("d", x, seed, 10 * x + seed) for x in (1.0, 0.0, 0.1) for seed in (0, 1)]
    (axes,) = plots.lambda_curves([dict(zip(names, p, strict=True)) for p in points]).axes
    np.testing.assert_allclose(axes.lines[0].get_ydata(), [0.5, 1.5, 10.5])


def test_one_command_draws_what_it_can_and_names_the_rest(runs: Path, tmp_path: Path) -> None:
    results, out, copied = (tmp_path / name for name in ("rows.jsonl", "figures", "copied"))
    about = {"suite": "control", "table": "lambda", "method": "ucf", "checkpoint": "last"}
    of = [{"budget": "small", "lambda_mask": weight} for weight in (0.0, 0.1)]
    rows = [result_row(1.0, metric="score", **about, conditions=each) for each in of]
    append_rows(results, rows)
    shutil.copytree(runs, copied)
    record = copied / "tangent" / "run.json"
    record.write_text(json.dumps(read_json(record) | {"store": str(tmp_path / "gone")}))
    command = ("figures", "--runs", copied, "--results", results, "--out", out)
    printed, said = control(*command)
    drawn = {"lambda-small", "moves-faithful", "states-faithful", "acceptance-faithful"}
    drawn |= {"attention-faithful", "moves-tangent", "scores-small-lambda"}
    pictures = {f"{name}.{kind}" for name in drawn for kind in ("png", "svg")}
    assert {path.name for path in out.iterdir()} == pictures
    assert all(f"{name}.svg" in printed for name in drawn)
    assert "missing: robustness: needs rows of `ucfrec-control robustness`" in said
    _, missing = make_figures([], [], out)
    assert {line.partition(":")[0] for line in missing} == set(NEEDS)

"""The command line. Heavy imports wait until a command is known."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from ucfrec import __version__
from ucfrec.cli import Commands, run, train_options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status, which means what `ucfrec.cli.main`'s does."""

    def commands() -> Commands:
        from ucfrec_control.commands import COMMANDS

        return COMMANDS

    return run(build_parser(), commands, arguments)


def build_parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    parser = argparse.ArgumentParser(
        prog="ucfrec-control",
        description="Train and judge policies on D4RL and Minari datasets.",
    )
    parser.add_argument("--version", action="version", version=f"ucfrec {__version__}")
    parser.add_argument("--debug", action="store_true", help="show tracebacks of input errors")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _prepare(commands.add_parser("prepare", help="a dataset to an episode store"))
    _collect(commands.add_parser("collect", help="datasets from a SAC learner; resumes"))
    _convert(commands.add_parser("convert", help="D4RL HDF5 to Minari, or back"))
    _distract(commands.add_parser("distract", help="a store with a distractor in its states"))
    _screen(commands.add_parser("screen", help="which state dimensions cause anything"))
    _screen_all(
        commands.add_parser("screen-all", help="screening of every zoo file, distracted; resumes")
    )
    _train(commands.add_parser("train", help="train a policy on a store; resumes"))
    _evaluate(commands.add_parser("evaluate", help="normalised scores of trained policies"))
    _benchmark(commands.add_parser("benchmark", help="every learner on the zoo files; resumes"))
    _robustness(commands.add_parser("robustness", help="what distractors cost; resumes"))
    _figures(commands.add_parser("figures", help="figures of runs and result rows"))
    return parser


def _source_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source", metavar="SOURCE", help="HDF5 file, Minari identifier, or folder of one"
    )
    parser.add_argument("--env", help="environment that the data is of, if it does not say so")
    parser.add_argument("--download", action="store_true", help="let Minari fetch the dataset")


def _prepare(parser: argparse.ArgumentParser) -> None:
    _source_options(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="STORE")


def _collect(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--env", required=True, help="Gymnasium environment, e.g. Hopper-v5")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--steps", type=int, default=1_000_000, help="of training (1000000)")
    parser.add_argument(
        "--every", type=int, default=10_000, help="steps between evaluations (10000)"
    )
    parser.add_argument(
        "--fraction", type=float, default=1 / 3, help="of the expert's return, for medium (1/3)"
    )
    parser.add_argument(
        "--size", type=int, default=1_000_000, help="steps of medium and of expert (1000000)"
    )
    parser.add_argument("--seed", type=int, default=0)


def _convert(parser: argparse.ArgumentParser) -> None:
    _source_options(parser)
    parser.add_argument(
        "target", metavar="TARGET", help="FILE.hdf5, or a Minari identifier such as hopper/mine-v0"
    )


def _distract(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("store", type=Path, metavar="STORE")
    parser.add_argument("--out", type=Path, required=True, metavar="STORE")
    parser.add_argument("--flip", type=float, default=0.0, help="chance that it is wrong (0)")
    parser.add_argument("--early", action="store_true", help="tell of the next step's reward")
    parser.add_argument("--seed", type=int, default=0)


def _screen(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("store", type=Path, metavar="STORE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the report here")


def _train(parser: argparse.ArgumentParser) -> None:
    train_options(parser)
    parser.add_argument(
        "--screen",
        choices=["copies", "drop"],
        help="screen the state: intervene on what causes nothing, or leave it out",
    )


def _evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--env", help="environment (that of the data)")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--target",
        type=float,
        action="append",
        default=[],
        help="return asked of an episode; repeatable (the preset's)",
    )
    parser.add_argument("--checkpoint", choices=["both", "best", "last"], default="both")
    parser.add_argument(
        "--distractor", type=float, default=0.0, help="what distractors are fixed to (0)"
    )
    parser.add_argument(
        "--video", type=Path, metavar="MP4", help="show an episode: FILE.mp4, or folder for frames"
    )
    parser.add_argument("--json", type=Path, help="write the result rows here")


def _benchmark(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("data", type=Path, metavar="DATA", help="folder of the HDF5 files")
    parser.add_argument(
        "--table",
        default="main",
        choices=["main", "lambda", "gate", "band", "augmentation"],
        help="every learner (main), or a sweep over UCF's settings",
    )
    _budget_options(parser)
    _grid_outputs(parser, "control")


def _robustness(parser: argparse.ArgumentParser) -> None:
    _budget_options(parser)
    _grid_options(parser, "control_robustness")


def _screen_all(parser: argparse.ArgumentParser) -> None:
    _grid_options(parser, "control_screening")


def _budget_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--budget", default="small", choices=["small", "full"])
    parser.add_argument(
        "--file",
        action="append",
        default=[],
        help="of the data folder, without its ending; repeatable (the budget's)",
    )
    parser.add_argument(
        "--method", action="append", default=[], help="row of the table; repeatable (all)"
    )
    parser.add_argument("--seeds", type=int, help="how many, from 0 (the budget's)")


def _grid_options(parser: argparse.ArgumentParser, results: str) -> None:
    parser.add_argument(
        "--data", type=Path, required=True, metavar="FOLDER", help="of the HDF5 files"
    )
    _grid_outputs(parser, results)


def _grid_outputs(parser: argparse.ArgumentParser, results: str) -> None:
    parser.add_argument("--out", type=Path, default=Path("runs/control"), help="stores and runs")
    parser.add_argument(
        "--results",
        type=Path,
        default=Path(f"benchmarks/results/{results}.jsonl"),
        metavar="JSONL",
    )
    parser.add_argument("--workers", type=int, default=1, help="processes of one thread each (1)")


def _figures(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--runs", nargs="*", type=Path, default=[], metavar="RUN", help="runs, or folders of runs"
    )
    parser.add_argument("--results", nargs="*", type=Path, default=[], metavar="ROWS")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")


if __name__ == "__main__":
    sys.exit(main())

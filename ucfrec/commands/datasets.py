"""`ucfrec datasets`: list public data sets, or download one."""

import argparse
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from ucfrec.commands.options import option
from ucfrec.errors import InputError, InputNote

if TYPE_CHECKING:
    from ucfrec.logs.mapping import Dataset


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `ucfrec datasets`."""
    option(parser, "name", str, "data set to load (default: list them)", "NAME", nargs="?")
    text = "where its archive lies or is downloaded to, and is unpacked"
    option(parser, "--folder", Path, text, "DIR")
    text = "of open-bandit: logging policy and campaign (default: random/all)"
    option(parser, "--part", str, text)
    parser.epilog = "Downloads need ucfrec[datasets] (pooch). Mind the licence of each data set."


def run(options: argparse.Namespace) -> None:
    """Run `ucfrec datasets`: print the list, or how the loaded logs are prepared.

    Raises:
        InputError: there is no such data set, no folder is named, or it cannot be downloaded.
    """
    from ucfrec.logs.mapping import find_release, load_release
    from ucfrec.reporting.tables import text_table

    adapters = _load_adapters()
    if options.name is None:
        lines = [
            (name, adapter, f"{release.size / 1e6:,.0f} MB", release.licence, release.homepage)
            for adapter, dataset in adapters.items()
            for name, release in dataset.releases.items()
        ]
        print(text_table(("name", "--dataset", "archive", "licence", "from"), lines))
        print("\nnext: ucfrec datasets NAME --folder DIR")
        return
    adapter = find_release(adapters, options.name)
    if options.folder is None:
        raise InputError(f"no folder is named; add --folder DIR for the files of {options.name}")
    logs = load_release(adapter, adapters[adapter], options.name, options.folder, options.part)
    release = adapters[adapter].releases[options.name]
    part = release.parts[options.part or next(iter(release.parts))]
    print(
        f"{options.name}: {len(logs.files)} log files; {release.licence}, {release.homepage}\n"
        f"next: ucfrec prepare '{options.folder / options.name / part}' --dataset {adapter} "
        "--out store"
    )


def _load_adapters() -> "dict[str, Dataset]":
    """All installed datasets by name; warns of those that cannot be loaded."""
    from ucfrec.plugins import load_plugin, plugin_names

    adapters = {}
    for name in plugin_names("datasets"):
        try:
            adapters[name] = load_plugin("datasets", name)
        except InputError as error:
            warnings.warn(str(error), InputNote, stacklevel=2)
    return adapters

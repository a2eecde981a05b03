"""Later logs of the dataset that a policy was trained on, read as its training log was."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ucfrec import schema
from ucfrec.errors import InputError
from ucfrec.logs.expressions import Expression
from ucfrec.logs.mapping import Dataset, LogMapping
from ucfrec.plugins import load_plugin, plugin_names
from ucfrec.runs.record import RUN
from ucfrec.runs.trained_policy import TrainedPolicy


def later_logs(
    trained: TrainedPolicy, paths: Sequence[str | Path], stated: LogMapping
) -> tuple[tuple[Path, ...], LogMapping]:
    """Log files of the dataset that a policy was trained on, whose columns may have plain names,
    with its feature tables. InputError if a path is missing, or holds no log of the dataset.

    Args:
        paths: files, folders and globs.
        stated: what the caller says of the columns.
    """
    source = trained.record.data
    # A record may also name a dataset that is not read by an adapter.
    has_adapter = source.dataset in plugin_names("datasets")
    dataset: Dataset = load_plugin("datasets", str(source.dataset) if has_adapter else "generic")
    remembered = LogMapping.of_source(source, str(trained.folder)).remembered or LogMapping()
    try:
        files, mapping = dataset.resolve(paths, stated)
    except InputError:
        files, mapping = dataset.resolve(paths, stated.over(LogMapping(remembered.columns)))
    columns = {name: text for name, text in mapping.columns.items() if name not in stated.columns}
    return files, replace(
        stated,
        item_features=mapping.item_features,
        user_features=mapping.user_features,
        remembered=LogMapping(columns),
    )


def columns_used(trained: TrainedPolicy, mapping: LogMapping) -> LogMapping:
    """The mapping with what the run remembers of its training log."""
    mapping = mapping.over(LogMapping.of_source(trained.record.data, str(trained.folder / RUN)))
    if trained.record.observation_size:
        return mapping
    return LogMapping({schema.OBSERVATION: ""}).over(mapping)


def reward_of(trained: TrainedPolicy) -> Expression:
    """The run's reward, an SQL expression over the columns of its logs."""
    return Expression(trained.record.reward, str(trained.folder / RUN))

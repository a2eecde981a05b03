"""File and column mappings of the datasets of `ucfrec prepare --dataset NAME`, and their logs."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ucfrec.logs.mapping import LogFiles

__all__ = ["load"]


def load(name: str, folder: Path | str, part: str | None = None) -> "LogFiles":
    """The logs of a public data set, with their columns mapped, for `Recommender.fit`.

    Where they are not in the folder, they are downloaded (needs ucfrec[datasets]), compared with
    the checksum of the release and unpacked; an archive that lies in the folder is used instead.

    Args:
        name: "kuairand-pure", "kuairec", "open-bandit" or "movielens-100k".
        part: of "open-bandit", the logging policy and campaign, such as "bts/men"; None for
            "random/all".

    Raises:
        InputError: there is no such data set or part, or it cannot be downloaded; the message says
            how to do it by hand.
    """
    from ucfrec.logs.mapping import find_release, load_release
    from ucfrec_datasets import kuairand, kuairec, movielens, obd

    adapters = {
        "kuairand": kuairand.DATASET,
        "kuairec": kuairec.DATASET,
        "movielens": movielens.DATASET,
        "obd": obd.DATASET,
    }
    adapter = find_release(adapters, name)
    return load_release(adapter, adapters[adapter], name, Path(folder), part)

"""`ucfrec train`: train a policy on a store; `settings` lists its settings, `tune` chooses them."""

import inspect
import json
import shutil
import textwrap
import warnings
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Literal

from ucfrec.commands.options import ARGUMENT, INPUT_FOLDER, POSITIVE, Names, Table, read_docstrings
from ucfrec.errors import InputError, InputNote
from ucfrec.policies.registry import policy_names

if TYPE_CHECKING:
    from ucfrec.runs.record import RunRecord

_WIDEST = 160
"""Most terminal columns of a line."""


class TrainingOptions(Table):
    """Options of `train` of `ucfrec` and of other programs."""

    epilog = "Every setting, its range and meaning: ucfrec settings --policy NAME"

    store: Annotated[Path, ARGUMENT, INPUT_FOLDER]
    """Episode store to train on; also at s3://, gs://, hdfs://, …"""
    out: Annotated[Path, "RUN"]
    """Folder of the run; an unfinished run in it is resumed."""
    policy: Annotated[str, Names(policy_names)] = "ucf"
    """Policy."""
    config: Path | None = None
    """TOML file of settings with one table per section (default: none)"""
    set: Annotated[Sequence[str], "TABLE.FIELD=VALUE"] = ()
    """One setting, e.g. train.steps=2000; overrides --config; repeatable (default: none)"""
    seed: int = 0
    """Seed of weights and batches."""
    threads: Annotated[int | None, POSITIVE] = None
    """CPU threads (default: all cores)"""


class Train(TrainingOptions):
    """`ucfrec train`."""

    refit: Annotated[Path | None, "RUN"] = None
    """Go on training this finished run, with its settings and decision rule, on all rows, in --out
    (default: a new training)"""
    no_refit: bool = False
    """Keep the weights of the training rows; (default: go on learning from all rows; `rank` and
    `ope` on the test split use the weights before that)"""
    goal: Literal["rank", "reward"] | None = None
    """`rank` what users choose next, or bring the most `reward` (default: reward, if it varies)"""
    evidence: int | None = None
    """Effective users that the decision rule must leave in the validation sessions; where the log
    has propensities, so that `ope` can estimate its value; 0 for any (default: 200)"""

    def execute(self) -> None:
        """Train, in this process or as one of those of `torchrun`."""
        import torch

        from ucfrec.episodes.store import EpisodeStore
        from ucfrec.fitting.distributed import joined, leads, wait
        from ucfrec.python_api.training import train_policy
        from ucfrec.reporting.model_card import write_card
        from ucfrec.runs.config import resolve_config
        from ucfrec.runs.refit import refit

        if self.threads:
            torch.set_num_threads(self.threads)
        with joined():
            if not leads():
                warnings.simplefilter("ignore", InputNote)  # the leader prints them
                wait()  # until the leader has begun the run
            store = EpisodeStore.open(self.store)
            if self.refit is None:
                settings = [*self.set]
                if self.goal is not None:
                    settings.append(f"rule.choose={json.dumps(self.goal == 'reward')}")
                if self.evidence is not None:
                    settings.append(f"rule.evidence={self.evidence}")
                config = resolve_config(self.policy, self.config, settings, self.seed)
                record = train_policy(store, self.out, config, not self.no_refit)
            elif self.config or self.set or self.goal or self.evidence is not None:
                raise InputError(
                    "--refit takes all settings of the run; omit --config, --set, --goal and "
                    "--evidence"
                )
            else:
                record = refit(store, self.refit, self.out)
                if leads():
                    write_card(self.out)
            if leads():
                self._describe(record)

    def _describe(self, record: "RunRecord") -> None:
        from ucfrec.files.record import CARD
        from ucfrec.fitting.checkpoint import read_metrics
        from ucfrec.runs.record import REFIT, RUN, read_record

        print(record.describe(read_metrics(self.out / "policy")))
        if (self.out / REFIT / RUN).exists():
            whole = read_record(self.out / REFIT)
            print(f"refit         {whole.train_steps:,} rows, all of the store")
        run = quote(str(self.out))
        print(f"\nrun: {self.out} (TensorBoard can open it)\nmodel card: {self.out / CARD}")
        if record.ranking is not None:
            print(f"next: ucfrec rank {run}, on the test split of the store")
        elif record.rule is None:
            print(f"next: ucfrec evaluate {run} --env NAME, in a simulator of these actions")
        else:
            held_out = ", its value on the test split of the store"
            if record.refit_of is not None:
                held_out = " LOGS, its value on later logs"
            print(
                f"next: ucfrec ope {run}{held_out}\n"
                f"      ucfrec recommend {run} LOGS --out FILE, the next items of every user"
            )


class Tune(Table):
    """`ucfrec tune`."""

    epilog = "Needs ucfrec[tune] (Optuna). The test split stays unseen."

    store: Annotated[Path, ARGUMENT]
    """Episode store to train on."""
    out: Path
    """Folder of the search; an unfinished search in it is resumed."""
    policy: Annotated[Sequence[str], Names(policy_names)] = ()
    """Policy (default: ucf); repeatable to search the policy too; one of"""
    trials: int = 30
    """Trainings that the search has at the end."""
    metric: Literal["value", "ndcg", "gauc"] = "value"
    """What is maximised: return in the user model, or NDCG or GAUC on validation rows"""
    k: Annotated[int, POSITIVE] = 10
    """Items recommended, of --metric ndcg."""
    space: Path | None = None
    """TOML file of settings to search, each a list of choices or {low = …, high = …, log = true}
    (default: learning rate, steps, width, dropout, context, exposure features and augmentation of
    networks, neighbours of item-knn; with ndcg and gauc also the reward weight)"""
    set: Annotated[Sequence[str], "TABLE.FIELD=VALUE"] = ()
    """A setting that all trials have, e.g. train.steps=2000; repeatable (default: none)"""
    workers: int = 1
    """Trainings side by side, each in a process."""
    no_pruning: bool = False
    """Train every trial to its end; (default: end those whose validation loss is above the median
    of earlier ones)"""
    seed: int = 0
    """Seed of the search and of every training."""

    def execute(self) -> None:
        """Print the best settings."""
        from ucfrec.runs.config import settings_given
        from ucfrec.tuning.space import Search, read_space
        from ucfrec.tuning.study import BEST, BEST_TOML, PAGE, Plan, tune

        search = Search(
            tuple(dict.fromkeys(self.policy or ["ucf"])),
            settings_given(self.set),
            self.metric == "value",
            self.seed,
            read_space(self.space) if self.space else None,
        )
        plan = Plan(self.store, self.out, search, self.metric, self.k, not self.no_pruning)
        tune(plan, self.trials, self.workers)
        measure = "ope" if self.metric == "value" else "rank"
        print((self.out / BEST_TOML).read_text(encoding="utf-8"))
        print(
            f"selected on validation rows; settings: {self.out / BEST_TOML}\n"
            f"all trials and the importance of settings: {self.out / PAGE}\n"
            f"next: ucfrec {measure} {quote(str(self.out / BEST))}, on the unseen test split"
        )


class Settings(Table):
    """`ucfrec settings`."""

    policy: Annotated[str, Names(policy_names)] = "ucf"
    """Policy whose settings to list."""

    def execute(self) -> None:
        """Print them."""
        print(settings_text(self.policy, shutil.get_terminal_size().columns))


def settings_text(policy: str, width: int) -> str:
    """Every setting of a training of `policy`, one section per table."""
    from ucfrec.runs.config import TABLES, resolve_config
    from ucfrec.settings import allowed_values

    config, width = resolve_config(policy), min(width, _WIDEST)
    text = textwrap.wrap(
        f"Settings of `ucfrec train --policy {policy}`: --set KEY=VALUE, or a TOML file "
        "(--config FILE) with a table for each section.",
        width,
    )
    for name in TABLES:
        table, indent = getattr(config, name), " " * 6
        classes = type(table).__mro__[:-1]  # the last one is object
        summary = inspect.cleandoc(type(table).__doc__ or "").partition("\n\n")[0]
        text += ["", *textwrap.wrap(f"[{name}]  {summary}", width)]
        for field in (field.name for field in fields(table)):
            texts = (
                read_docstrings(cls.__module__).get(f"{cls.__name__}.{field}", ("", ""))[0]
                for cls in classes
            )
            meaning, value = next(filter(None, texts), ""), getattr(table, field)
            words = value if isinstance(value, str) else json.dumps(value)
            words = "unset" if value is None else words
            text.append(f"  {f'{name}.{field}':<26}  {words:<22}  {allowed_values(table, field)}")
            text += textwrap.wrap(meaning, width, initial_indent=indent, subsequent_indent=indent)
    return "\n".join(text)

"""Processes that `torchrun` started, which train one policy together.

The processes divide every batch and average their gradients, so that they take the steps of one
process with the whole batch. The first, the leader, does everything else: it alone writes files,
prints, and fits what comes before and after the policy; the others wait for it.
"""

import os
import signal
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta

import torch
from torch import Tensor, distributed, nn

from ucfrec.errors import InputError

_LONGEST_WAIT = timedelta(days=30)
"""How long the others wait for what the leader fits alone."""


def processes() -> int:
    """Number of processes that train together; 1 for an ordinary command."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def rank() -> int:
    """Number of this process, 0 for the leader."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def leads() -> bool:
    """Whether this process is the leader, as that of an ordinary command is."""
    return rank() == 0


@contextmanager
def joined() -> Iterator[None]:
    """Join the other processes of `torchrun`, if it started this one among several.

    Communication is by gloo, and by NCCL between GPUs, of which each process takes its own. A
    process that is not the leader has nothing to save: TERM ends it at once, whatever it does.
    InputError if another process of the training has ended.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    on_gpu = torch.cuda.is_available() and distributed.is_nccl_available()
    if on_gpu:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    backend = "cpu:gloo,cuda:nccl" if on_gpu else "gloo"
    distributed.init_process_group(backend, timeout=_LONGEST_WAIT)
    if not leads():
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        yield
    except RuntimeError as error:
        # gloo and NCCL say in many words that no process answers; torch has no type for it.
        if any(phrase in str(error) for phrase in ("closed by peer", "Connection re", "NCCL")):
            raise InputError(
                "another process of this training has ended; see what it printed, then start the "
                "same command again, which resumes from the last checkpoint"
            ) from None
        raise
    finally:
        distributed.destroy_process_group()


def wait() -> None:
    """Wait until every process has come here."""
    if processes() > 1:
        distributed.all_reduce(torch.zeros(1))


@contextmanager
def leader_first() -> Iterator[None]:
    """The leader runs the block; once it has left it, the others do, and find what it wrote."""
    if not leads():
        wait()
    yield
    if leads():
        wait()


def share(whole: int) -> slice:
    """The part of `whole` windows of a batch, or of anything divided, that is this process's.
    InputError if there are fewer of them than processes."""
    if whole < processes():
        raise InputError(
            f"a batch of {whole} cannot be divided among {processes()} processes; set "
            "train.batch_size, which counts the windows of all processes, or start fewer"
        )
    return slice(rank() * whole // processes(), (rank() + 1) * whole // processes())


def joint_means(means: Mapping[str, float], count: float) -> dict[str, float]:
    """Means over the rows of all processes, from those over the `count` rows of this one."""
    values = torch.tensor([*(mean * count for mean in means.values()), count], dtype=torch.float64)
    if processes() > 1:
        distributed.all_reduce(values)
    return dict(zip(means, (values[:-1] / values[-1]).tolist(), strict=True))


def average_gradients(parameters: Iterable[nn.Parameter], count: float) -> None:
    """Replace gradients, of the same layout everywhere, by their means over all processes.

    `count` is the number of rows of this process that its loss is a mean of.
    """
    gradients = [
        (parameter, parameter.grad) for parameter in parameters if parameter.grad is not None
    ]
    dense = [grad for _, grad in gradients if not grad.is_sparse]
    total = torch.tensor([float(count)], device=gradients[0][1].device)
    # One message takes less time than one for every gradient.
    message = torch.cat([total, nn.utils.parameters_to_vector(dense) * total])
    distributed.all_reduce(message)
    nn.utils.vector_to_parameters(message[1:] / message[0], dense)
    for table, grad in gradients:
        if grad.is_sparse:
            table.grad = _joint_rows(grad.coalesce(), total / message[0])


def _joint_rows(gradient: Tensor, weight: Tensor) -> Tensor:
    """The sum over processes of sparse gradients times their weights."""
    rows, values = gradient.indices()[0], gradient.values() * weight
    size = torch.tensor([len(rows)], device=rows.device)
    sizes = [torch.empty_like(size) for _ in range(processes())]
    distributed.all_gather(sizes, size)
    counts = [int(size) for size in sizes]
    # Messages have to be of one size, that of the largest.
    joined = []
    for part in (rows, values):
        padded = part.new_zeros((max(counts), *part.shape[1:]))
        padded[: len(part)] = part
        parts = [torch.empty_like(padded) for _ in range(processes())]
        distributed.all_gather(parts, padded)
        of_all = [part[:n] for part, n in zip(parts, counts, strict=True)]
        joined.append(torch.cat(of_all))
    places, summands = joined[0].unsqueeze(0), joined[1]
    return torch.sparse_coo_tensor(places, summands, gradient.shape, check_invariants=False)

"""The processes of a data-parallel run, started by `torchrun`: each collects and learns from its share of the environments.

N ranks compute the same as one process with all environments. Environments and action noise are numbered over all ranks; every
rank divides the steps of all environments into the same minibatches and learns from its own part of each; gradients are summed,
weighted by the number of steps.

```console
torchrun --nproc-per-node=2 -m endless_gym_agents.train -- --env MortarMayhem-Grid-v0 --preset quick
```
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

T = TypeVar("T")

#: Time after which a rank stops waiting for another rank. A rank that has ended is noticed at once.
TIMEOUT = timedelta(minutes=10)


class RankLost(OSError):
    """Another rank of the run has ended, or does not answer."""


class Ranks:
    """The ranks of this run. A process that `torchrun` did not start is the only rank.

    Attributes:
        rank: Number of this process, 0 to `size - 1`.
        size: Number of processes.
        local_rank: Number of this process among those on this machine.
        local_size: Number of processes on this machine.
        restarts: How often `torchrun` has restarted the run.
    """

    def __init__(self) -> None:
        """Read the environment variables that `torchrun` sets."""
        # Require both, so that a stray `RANK` from a cluster's scheduler is ignored.
        given = os.environ if "RANK" in os.environ and "MASTER_ADDR" in os.environ else {}
        self.rank, self.size = int(given.get("RANK", 0)), int(given.get("WORLD_SIZE", 1))
        self.local_rank, self.local_size = int(given.get("LOCAL_RANK", 0)), int(given.get("LOCAL_WORLD_SIZE", 1))
        self.restarts = int(given.get("TORCHELASTIC_RESTART_COUNT", 0))
        self._cores = sorted(os.sched_getaffinity(0))

    @property
    def is_first(self) -> bool:
        """Whether this process writes the logs and the checkpoints."""
        return self.rank == 0

    @contextmanager
    def connected(self) -> Iterator[None]:
        """Connect the ranks, with NCCL for tensors on CUDA devices and gloo for others.

        Raises:
            RankLost: Another rank ended, or did not answer.
        """
        if self.size == 1:
            yield
            return
        # Functions of this PyTorch module capture the process group at import as a default argument. A later import (by
        # torch._dynamo, which optimizers import) would keep the group and its threads alive until the interpreter exits.
        import torch.distributed.nn.functional

        backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
        with self._watched("could not be reached"):
            store, rank, size = next(rendezvous("env://", timeout=TIMEOUT))
            # After a restart, the store may still contain the addresses of processes that have ended.
            store = PrefixStore(f"restart-{self.restarts}", store)
            distributed.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=TIMEOUT)
        with self._watched("has ended or does not answer"):
            yield
            # Not after an error: other ranks may no longer answer.
            distributed.destroy_process_group()

    @contextmanager
    def _watched(self, what: str) -> Iterator[None]:
        try:
            yield
        except distributed.DistError as error:
            raise RankLost(self._lost(what, error)) from error
        except RuntimeError as error:
            # gloo raises plain RuntimeErrors.
            if "gloo" in str(error) or "onnection" in str(error):
                raise RankLost(self._lost(what, error)) from error
            raise

    def _lost(self, what: str, error: Exception) -> str:
        reason = str(error).splitlines()[0]
        return f"rank {self.rank} of {self.size}: another rank {what} ({reason})"

    @property
    def threads(self) -> int | None:
        """Threads that step this rank's environments: its share of the cores; `None`, one per core, for a machine's only rank."""
        return None if self.local_size == 1 else max(1, len(self.cores))

    @property
    def cores(self) -> list[int]:
        """The rank's share of the cores that the process could use when it started."""
        share = len(self._cores) // self.local_size
        return self._cores[self.local_rank * share :][:share]

    def bind(self) -> None:
        """Bind this process, and the engine that it starts, to `cores`.

        Raises:
            ValueError: There are fewer cores than ranks on this machine.
        """
        if not self.cores:
            given = f"{len(self._cores)} for {self.local_size} ranks"
            raise ValueError(f"--bind-cores needs a core for each rank of a machine, got {given}; omit the flag")
        os.sched_setaffinity(0, self.cores)

    def check(self, num_envs: int, groups: int) -> None:
        """Check that the environments can be divided.

        Raises:
            ValueError: They cannot.
        """
        if num_envs % (groups * self.size):
            raise ValueError(
                f"--environment.num-envs must be a multiple of {groups} groups times {self.size} ranks, got {num_envs}"
            )

    def share(self, total: int) -> range:
        """The rank's share of `total` consecutive numbers; `total` is a multiple of the number of ranks."""
        size = total // self.size
        return range(self.rank * size, (self.rank + 1) * size)

    def columns(self, tensor: Tensor) -> Tensor:
        """Concatenate the columns of all ranks: (T, N), from this rank's (T, n)."""
        if self.size == 1:
            return tensor
        # Not every backend supports booleans.
        sent = tensor.byte() if tensor.dtype == torch.bool else tensor
        sent = sent.contiguous()
        parts = [torch.empty_like(sent) for _ in range(self.size)]
        distributed.all_gather(parts, sent)
        return torch.cat(parts, dim=1).to(tensor.dtype)

    def add(self, tensors: Iterable[Tensor]) -> None:
        """Replace tensors by their sums over all ranks, in one operation. The results are bitwise equal on all ranks."""
        if self.size == 1:
            return
        tensors = list(tensors)
        joined = torch.cat([tensor.reshape(-1) for tensor in tensors])
        distributed.all_reduce(joined)
        for tensor, part in zip(tensors, joined.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(part.view_as(tensor))

    def copy_from_first(self, tensors: Iterable[Tensor]) -> None:
        """Replace tensors by those of rank 0."""
        if self.size > 1:
            for tensor in tensors:
                distributed.broadcast(tensor, 0)

    def of_first(self, make: Callable[[], T]) -> T:
        """Call `make` on rank 0 only, and return its result on all ranks. Its error is raised on rank 0.

        Raises:
            RankLost: On the other ranks: `make` failed on rank 0.
        """
        if self.size == 1:
            return make()
        answer: list[Any] = [None, None]
        error: Exception | None = None
        if self.is_first:
            try:
                answer[0] = make()
            except Exception as raised:
                answer[1], error = str(raised), raised
        distributed.broadcast_object_list(answer, 0, device=torch.device("cpu"))
        if error is not None:
            raise error
        if answer[1] is not None:
            raise RankLost(f"rank {self.rank} of {self.size}: rank 0 stopped: {answer[1]}")
        value: T = answer[0]
        return value

    def gathered(self, value: Any) -> list[Any] | None:
        """The values of all ranks on rank 0, with tensors on the CPU; `None` on the others."""
        if self.size == 1:
            return [value]
        values = [None] * self.size if self.is_first else None
        distributed.gather_object(on_cpu(value), values, 0)
        return values

    def everywhere(self, value: Any) -> list[Any]:
        """The values of all ranks, on every rank."""
        if self.size == 1:
            return [value]
        values = [None] * self.size
        distributed.all_gather_object(values, value)
        return values


def on_cpu(value: Any) -> Any:
    """A value of dicts, lists and tensors, with the tensors on the CPU."""
    if isinstance(value, Tensor):
        return value.cpu()
    if isinstance(value, dict):
        return {key: on_cpu(part) for key, part in value.items()}
    return [on_cpu(part) for part in value] if isinstance(value, list) else value

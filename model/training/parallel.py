"""One training run in many processes: ``torchrun`` starts them, each takes its slice of every batch.

Every process holds the whole model (DDP), or its share of it where the model needs that (FSDP, ``fully_shard``). What is saved
is always whole, so a run may go on with another number of processes.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

if TYPE_CHECKING:
    from torch.distributed.device_mesh import DeviceMesh


@dataclass(frozen=True)
class Group:
    """The processes of a run; this one is number ``rank`` of ``world``, and ``device`` is its own."""

    device: torch.device
    rank: int = 0
    world: int = 1
    mesh: DeviceMesh | None = None  # all of them in one row, which FSDP splits over; None: this process alone

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes and speaks."""
        return self.rank == 0

    def mean(self, value: Tensor) -> Tensor:
        """The mean over all processes of equally large tensors."""
        if self.world > 1:
            dist.all_reduce(value)
            value = value / self.world
        return value

    def tell(self, text: str) -> str:
        """The leading process's text, on all of them."""
        if self.world == 1:
            return text
        box = [text]
        dist.broadcast_object_list(box, src=0, device=torch.device("cpu"))
        return box[0]

    def wait(self) -> None:
        """Until all processes have come here."""
        if self.world > 1:
            dist.barrier()


@contextmanager
def join(device: str) -> Iterator[Group]:
    """The group that ``torchrun`` described in the environment, or this process alone."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield Group(torch.device(device))
        return
    from torch.distributed.device_mesh import init_device_mesh

    own_device = torch.device(device)
    if own_device.type == "cuda":
        own_device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(own_device)
    dist.init_process_group("cpu:gloo,cuda:nccl" if own_device.type == "cuda" else "gloo")
    mesh = init_device_mesh(own_device.type, (world,))
    try:
        yield Group(own_device, dist.get_rank(), world, mesh)
    finally:
        dist.destroy_process_group()
        # Gloo's threads can abort an interpreter that ends (SIGABRT after a finished run), so they end first. What keeps them:
        getattr(mesh, "_pg_registry", {}).clear()  # DTensor's caches hold the mesh, and torch 2.13's mesh its groups
        gc.collect()  # a model split by FSDP holds itself


def distribute(model: nn.Module, group: Group, sharded: bool) -> nn.Module:
    """What to call instead of the model; ``sharded``: parameters, gradients and optimizer are split over the processes."""
    if group.world == 1:
        return model
    if sharded:
        from torch.distributed.fsdp import fully_shard

        for layer in model.layers():
            fully_shard(layer, mesh=group.mesh)
        # reshard: else validation, without a backward, would leave it whole
        return fully_shard(model, mesh=group.mesh, reshard_after_forward=True)
    from torch.nn.parallel import DistributedDataParallel

    devices = [group.device] if group.device.type == "cuda" else None
    return DistributedDataParallel(model, device_ids=devices, gradient_as_bucket_view=True)


@contextmanager
def accumulating(forward: nn.Module, last: bool) -> Iterator[None]:
    """Gradients are exchanged with the other processes after the ``last`` part of a batch only."""
    if hasattr(forward, "set_requires_gradient_sync"):
        forward.set_requires_gradient_sync(last)
        yield
        return
    with forward.no_sync() if hasattr(forward, "no_sync") and not last else nullcontext():
        yield


def gather(value: Any) -> Any:
    """Nested containers with every split tensor made whole; all processes must call it."""
    from torch.distributed.tensor import DTensor

    if isinstance(value, dict):
        return {name: gather(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [gather(item) for item in value]
    return value.full_tensor() if isinstance(value, DTensor) else value


def scatter(value: Tensor, like: Tensor) -> Tensor:
    """The whole tensor split as ``like`` is."""
    from torch.distributed.tensor import DTensor, distribute_tensor

    if isinstance(like, DTensor) and value.shape == like.shape:
        return distribute_tensor(value.to(like.device), like.device_mesh, like.placements)
    return value

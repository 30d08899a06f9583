"""Gradients of a batch that is cut into parts: one part after the other, or several at a time, each on a thread of its own.

A small network keeps one core busy and little more: its operations are too short to share. Parts of a batch need nothing of
one another, so each core takes one. Gradients add up in the order of the parts: the sum has the same bytes for any number of
threads, as long as there are fewer than two for a part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch
from torch import Tensor

SMALL = 5_000_000  # parameters of a network whose optimizer, too, has operations that are too short to share

Loss = Callable[[], Tensor]  # of a part: a scalar with its graph


@contextmanager
def threads_kept() -> Iterator[None]:
    """Give torch its number of threads back: what a process trains next rounds as if it were the first."""
    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class SideBySide:
    """Threads that compute the gradients of ``parts`` parts, as many at a time as there are ``threads``.

    A small network's optimizer then has one thread, the caller's: this sets torch's number for it.
    """

    def __init__(self, parameters: Sequence[Tensor], parts: int, threads: int):
        self.parameters = [p for p in parameters if p.requires_grad]
        at_once = min(parts, threads)
        self.threads_of_one = threads // at_once
        if sum(p.numel() for p in self.parameters) < SMALL:
            torch.set_num_threads(self.threads_of_one)
        self.pool = ThreadPoolExecutor(at_once, "gradients", self._begin)

    def _begin(self) -> None:
        """Every thread has these settings of its own."""
        torch.set_num_threads(self.threads_of_one)
        torch.set_flush_denormal(True)

    def backward(self, losses: Sequence[Loss]) -> Tensor:
        """The sum of the losses, without a graph; its gradient is added to the parameters' own."""
        total, threads = torch.zeros(()), torch.get_num_threads()
        torch.set_num_threads(self.threads_of_one)  # the cores are taken: helpers that add would be waited for
        try:
            for loss, gradients in self.pool.map(self._gradients, losses):
                total = total + loss
                for parameter, gradient in zip(self.parameters, gradients, strict=True):
                    if gradient is not None:
                        parameter.grad = gradient if parameter.grad is None else parameter.grad.add_(gradient)
        finally:
            torch.set_num_threads(threads)
        return total

    def _gradients(self, loss: Loss) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        value = loss()
        return value.detach(), torch.autograd.grad(value, self.parameters, allow_unused=True)

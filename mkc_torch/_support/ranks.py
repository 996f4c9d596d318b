"""Sums over the processes of a distributed group; an error on one rank is raised on all ranks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor
from torch import distributed as dist

if TYPE_CHECKING:
    from jaxtyping import Float64

T = TypeVar("T")


class RanksError(RuntimeError):
    """Another process of the group failed or has ended."""


class Ranks:
    """The processes of a ``torch.distributed`` group, or this process alone.

    Every method returns on all ranks or raises on all ranks: the ranks exchange their errors before a result is used.
    With gloo, a process that ends closes its connections, so the others raise at once. A process that hangs, and any
    failure with nccl, is detected after the timeout of the group.

    Args:
        group: a ``torch.distributed`` group; None is the default group if it is initialised, else this process alone.

    Example:
        >>> Ranks().sum_of(lambda: torch.ones(2).double(), 2)
        tensor([1., 1.], dtype=torch.float64)
    """

    def __init__(self, group: Any = None) -> None:
        self.group = group
        self.alone = group is None and not (dist.is_available() and dist.is_initialized())
        self.size = 1 if self.alone else dist.get_world_size(group)
        self.rank = 0 if self.alone else dist.get_rank(group)
        if self.rank < 0:
            raise ValueError(
                "Expected argument `group` to contain this process; call it on the ranks of the group only."
            )

    def sum_of(self, work: Callable[[], Float64[Tensor, " k"]], length: int) -> Float64[Tensor, " k"]:
        """The elementwise sum over the ranks of the results of ``work``.

        Args:
            work: returns float64 numbers, (length,).
            length: count of the numbers.

        Raises:
            RanksError: another rank failed; on a rank that fails, its own error.
        """
        if self.alone:
            return work()
        # the last number is 1 if the rank failed, so that one message suffices
        flat, error = torch.zeros(length + 1, dtype=torch.float64), None
        try:
            flat[:-1] = work()
        except Exception as caught:  # any error of a user's batches, as the others wait for this rank; raised below
            flat[-1], error = 1.0, caught
        with _connected():
            moved = flat.to(self._device())
            dist.all_reduce(moved, group=self.group)
            flat = moved.cpu()
        if bool(flat[-1] > 0):
            self._raise(error)
        return flat[:-1]

    def gathered(self, work: Callable[[], T]) -> list[T]:
        """The results of ``work`` of all ranks, in the order of ranks, on each rank.

        Raises:
            RanksError: another rank failed; on a rank that fails, its own error.
        """
        if self.alone:
            return [work()]
        mine, error = None, None
        try:
            mine = work()
        except Exception as caught:  # raised below, once the others know
            error = caught
        found: list[Any] = [None] * self.size
        with _connected():
            dist.all_gather_object(found, (mine, _error_message(error)), group=self.group)
        self._raise_first(error, [message for _, message in found])
        return [value for value, _ in found]

    def from_first(self, work: Callable[[], T]) -> T:
        """The result of ``work`` on rank 0, on each rank, bit for bit the same on any processor.

        Raises:
            RanksError: rank 0 failed; there, its own error.
        """
        if self.alone:
            return work()
        result, error = None, None
        if self.rank == 0:
            try:
                result = work()
            except Exception as caught:  # raised below, once the others know
                error = caught
        box = [(result, _error_message(error))]
        source = 0 if self.group is None else dist.get_global_rank(self.group, 0)
        with _connected():
            dist.broadcast_object_list(box, src=source, group=self.group)
        self._raise_first(error, [box[0][1]])
        return box[0][0]  # type: ignore[return-value]

    def _device(self) -> torch.device:
        backend = str(dist.get_backend(self.group))
        return torch.device("cuda", torch.cuda.current_device()) if backend == "nccl" else torch.device("cpu")

    def _raise(self, error: Exception | None) -> None:
        messages: list[Any] = [None] * self.size
        with _connected():
            dist.all_gather_object(messages, _error_message(error), group=self.group)
        self._raise_first(error, messages)

    def _raise_first(self, error: Exception | None, messages: list[str | None]) -> None:
        if error is not None:
            raise error
        for rank, message in enumerate(messages):
            if message is not None:
                raise RanksError(f"Rank {rank} failed, so all ranks stopped: {message}")


def _error_message(error: Exception | None) -> str | None:
    return None if error is None else f"{type(error).__name__}: {error}"


@contextmanager
def _connected() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        raise RanksError(
            "Another process of the group is gone, or did not answer within the group's timeout; see its own output. "
            f"The message was: {str(error).splitlines()[0]}"
        ) from error

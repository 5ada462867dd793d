"""Many sequences side by side: what their searches ask for at a time is evaluated in one call.

    sessions = [TrackingSession(settings, first, views, generator=g) for ...]
    for posteriors in track_batch(zip(sessions, videos)):
        ...

Every sequence has a session of its own, with its own body, cameras, base and generator. A frame of
each is searched in a thread of its own; whoever wants samples evaluated waits until all others do,
and the samples of those with the same terms then are one batch, each with the index of its
sequence. No sample influences another, so that the results are those of one after the other: with
the fused engine bit for bit. The eager engine, that of a GPU, evaluates sequences that are alike as
one (`torchcss.cost.batched`), so that few samples of all cost as many calls as those of one; the
fused engine shares the samples of all out among its threads.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from torchcss.cost.batched import Merged
from torchcss.cost.total import Engine, TrackingCost, numbered, together
from torchcss.errors import ConfigurationError
from torchcss.tracking.session import Images, Posterior, TrackingSession
from torchcss.types import LocalModel

Sequences = Iterable[tuple[TrackingSession, Iterable[Images]]]
"""Sessions, each with the images of its moments."""


def track_batch(sequences: Sequences) -> Iterator[tuple[Posterior | None, ...]]:
    """Track many sequences side by side, a moment of each at a time.

    Args:
        sequences: Each session with its images; sessions of one body and the same settings share
            evaluations, others are tracked beside them. They may be of different lengths.

    Yields:
        What is known after each moment, one entry a sequence; None for one that has ended.

    Raises:
        ConfigurationError: If a session is given twice, or an iterator of images.
        TorchcssError: What is wrong with a sequence, when the others have done the same moment;
            every session then stands after the last moment that it did, as `checkpoint` tells.
    """
    sessions, images = [], []
    for session, its in sequences:
        sessions.append(session)
        images.append(iter(its))
    if not sessions:
        return
    if len(set(map(id, sessions))) < len(sessions) or len(set(map(id, images))) < len(images):
        raise ConfigurationError(
            "sequences: each needs a session and images of its own; one is given twice"
        )
    for device in {session.settings.device for session in sessions}:
        # The first call loads a device's solvers, which two threads must not do at once.
        torch.linalg.cholesky_ex(torch.eye(1, device=device))
    set_up = partial(torch.set_num_threads, torch.get_num_threads())
    with ThreadPoolExecutor(len(sessions), "sequence", initializer=set_up) as pool:
        while True:
            moment = [_next(its) for its in images]
            if all(each is None for each in moment):
                return
            yield _step(pool, sessions, moment)


def _next(images: Iterator[Images]) -> Images | Exception | None:
    """The images of the next moment; None after the last, and what is wrong if they fail."""
    try:
        return next(images, None)
    except Exception as error:
        return error


def _step(
    pool: ThreadPoolExecutor,
    sessions: Sequence[TrackingSession],
    moment: list[Images | Exception | None],
) -> tuple[Posterior | None, ...]:
    """One moment of all sequences that have not ended."""
    going = [number for number, images in enumerate(moment) if images is not None]
    collector, enabled = _Collector(len(going)), torch.is_grad_enabled()

    def search(number: int) -> Posterior:
        images, session = moment[number], sessions[number]
        assert images is not None
        # On a CPU threads that hand over to each other at every call take half as long again.
        alone = collector.turn if session.settings.device == "cpu" else nullcontext()
        with alone:
            try:
                if isinstance(images, Exception):
                    raise images
                with torch.set_grad_enabled(enabled):
                    seen = session.observe(images)
                    return session.step(seen, partial(collector.collecting, number))
            finally:
                collector.leave()

    futures: dict[int, Future[Posterior]] = {n: pool.submit(search, n) for n in going}
    for future in futures.values():
        future.exception()  # waits
    found = {number: future.result() for number, future in futures.items()}
    return tuple(found.get(number) for number in range(len(moment)))


@dataclass(eq=False)
class _Request:
    """What one search wants to know.

    Attributes:
        what: Method of the cost.
        cost: The cost of its samples, numbered.
        x: The samples.
        answer: What comes back; an exception is raised by who asked.
    """

    what: Literal["value", "local_model"]
    cost: TrackingCost
    x: Tensor
    answer: Any = None


@dataclass(eq=False)
class _Collector:
    """Where the searches of one moment meet; the last to come evaluates for all.

    Attributes:
        size: Searches that have not ended.
        requests: What those want that wait.
        turn: Guards both; on a CPU a search holds it whenever it does not wait.
        merged: What stands for several of the sequences.
    """

    size: int
    requests: list[_Request] = field(default_factory=list)
    turn: threading.Condition = field(default_factory=threading.Condition)
    merged: Merged = field(default_factory=Merged)

    def collecting(self, number: int, cost: TrackingCost) -> TrackingCost:
        """The cost of one sequence, whose evaluations wait for those of the others."""
        return replace(numbered(cost, number), engine=_Collecting(self, cost.engine))

    def leave(self) -> None:
        """One search less to wait for."""
        with self.turn:
            self.size -= 1
            self._answer_if_all_wait()

    def evaluated(self, request: _Request) -> Any:
        """Wait for an answer."""
        with self.turn:
            self.requests.append(request)
            self._answer_if_all_wait()
            self.turn.wait_for(lambda: request.answer is not None)
        if isinstance(request.answer, BaseException):
            raise request.answer
        return request.answer

    def _answer_if_all_wait(self) -> None:
        if not self.requests or len(self.requests) < self.size:
            return
        left = sorted(self.requests, key=lambda request: request.cost.views[0].sequence)
        self.requests.clear()
        while left:
            alike = [request for request in left if _is_alike(request, left[0])]
            left = [request for request in left if request not in alike]
            try:
                _answer(alike, self.merged)
            except Exception as error:
                for request in alike:
                    request.answer = error
        self.turn.notify_all()


@dataclass(frozen=True, eq=False)
class _Collecting:
    """An `Engine` that leaves evaluations to the collector.

    Attributes:
        collector: The collector.
        engine: What evaluates in the end; None: the terms as they are written.
    """

    collector: _Collector
    engine: Engine | None

    def value(self, cost: TrackingCost, x: Tensor) -> Tensor:
        """See `TrackingCost.value`."""
        return self.collector.evaluated(_Request("value", replace(cost, engine=self.engine), x))

    def held_value(self, cost: TrackingCost, x: Tensor, found_at: Tensor) -> Tensor:
        """See `TrackingCost.held_value`; no search asks for it."""
        return replace(cost, engine=self.engine).held_value(x, found_at)

    def local_model(self, cost: TrackingCost, x: Tensor) -> LocalModel:
        """See `TrackingCost.local_model`."""
        return self.collector.evaluated(
            _Request("local_model", replace(cost, engine=self.engine), x)
        )


def _is_alike(one: _Request, other: _Request) -> bool:
    """Whether two searches can be answered by one evaluation."""
    if one is other:
        return True
    (a, x), (b, y) = (one.cost, one.x), (other.cost, other.x)
    same = one.what == other.what and a.engine is b.engine and a.choice == b.choice
    batches = x.ndim == y.ndim == 2 and x.shape[1] == y.shape[1]
    return same and batches and x.dtype == y.dtype and x.device == y.device


def _answer(requests: Sequence[_Request], merged: Merged) -> None:
    """Evaluate in one call; each gets its share."""
    sizes = [request.x.shape[:-1].numel() for request in requests]
    if len(requests) == 1:
        (request,) = requests
        request.answer = getattr(request.cost, request.what)(request.x)
        return
    x = torch.cat([request.x for request in requests])
    numbers = torch.tensor([request.cost.views[0].sequence for request in requests])
    sequence = numbers.repeat_interleave(torch.tensor(sizes)).to(x.device)
    every = together([request.cost for request in requests], sequence, merged)
    cost = replace(every, stopwatch=None)
    if requests[0].what == "value":
        shares: Sequence[Any] = cost.value(x).split(sizes)
    else:
        parts = (part.split(sizes) for part in cost.local_model(x))
        shares = [LocalModel(*share) for share in zip(*parts, strict=True)]
    for request, share in zip(requests, shares, strict=True):
        request.answer = share

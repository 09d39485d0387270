"""Requests that wait at the same time go through the network together."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from beambox.structures import Detections, Frame

__all__ = ["Batcher"]

DetectFrames = Callable[[Sequence[Frame]], list[Detections]]


class Batcher:
    """One thread that runs the detector on batches of waiting frames."""

    def __init__(self, detect: DetectFrames, size: int = 4, wait: float = 0.005) -> None:
        """Prepare; :meth:`start` begins.

        Args:
            detect: runs the network on frames; called in one thread only.
            size: frames that go through together at most.
            wait: seconds to wait for further frames once one is there.
        """
        self._detect, self.size, self.wait = detect, size, wait
        self._queue: asyncio.Queue[tuple[Frame, asyncio.Future[Detections]]] = asyncio.Queue()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="beambox-detect")
        self._task: asyncio.Task[None] | None = None
        self.batches = 0
        """Batches done."""
        self.frames = 0
        """Frames done."""

    @property
    def running(self) -> bool:
        """Whether frames are being taken."""
        return self._task is not None and not self._task.done()

    def start(self) -> None:
        """Begin to take frames; to be called inside the event loop."""
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def stop(self) -> None:
        """End; what waits is dropped, the batch in the network is waited for."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        self._thread.shutdown(wait=True, cancel_futures=True)

    async def submit(self, frame: Frame) -> Detections:
        """Detect in a frame, together with others that wait.

        Raises:
            Exception: whatever the detector raises for this frame.
        """
        answer: asyncio.Future[Detections] = asyncio.get_running_loop().create_future()
        await self._queue.put((frame, answer))
        return await answer

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            batch = await self._gather()
            batch = [(frame, answer) for frame, answer in batch if not answer.done()]  # some have given up waiting
            if not batch:
                continue
            found = await loop.run_in_executor(self._thread, self._each, [frame for frame, _ in batch])
            self.batches += 1
            self.frames += len(batch)
            for (_, answer), one in zip(batch, found):
                if answer.done():
                    continue
                if isinstance(one, Detections):
                    answer.set_result(one)
                else:
                    answer.set_exception(one)

    async def _gather(self) -> list[tuple[Frame, asyncio.Future[Detections]]]:
        batch = [await self._queue.get()]
        end = asyncio.get_running_loop().time() + self.wait
        while len(batch) < self.size:
            left = end - asyncio.get_running_loop().time()
            try:
                batch.append(await asyncio.wait_for(self._queue.get(), max(left, 0)))
            except (asyncio.TimeoutError, TimeoutError):
                break
        return batch

    def _each(self, frames: list[Frame]) -> list[Detections | Exception]:
        """Detect in all together; where that fails, in each by itself, so that one does not spoil the others."""
        try:
            return [*self._detect(frames)]
        except Exception as error:  # whatever it is belongs to the request, not to the service
            if len(frames) == 1:
                return [error]
        return [one for frame in frames for one in self._each([frame])]

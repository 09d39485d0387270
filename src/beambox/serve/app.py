"""The service as an ASGI application: ``POST /detect``, ``GET /health``, ``GET /model``."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
import tempfile
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beambox import __version__
from beambox.checks import BeamboxError, did_you_mean, expect_library, printable
from beambox.file_names import check_file_name
from beambox.serve.batching import Batcher
from beambox.serve.bodies import FORMATS, choose_format, read_body
from beambox.serve.limits import RequestError, ServeLimits
from beambox.structures import Frame

if TYPE_CHECKING:
    from collections.abc import Mapping

    from starlette.applications import Starlette
    from starlette.requests import Request

    from beambox.infer.predictor import Detector

__all__ = ["Service", "create_app", "expect_installed"]

LONGEST_MESSAGE = 1000
READERS = 2
"""Bodies that are read at a time; reading is Python's work and takes a core."""
TOLD = ("summary", "licence", "trained on", "sensor_height")
"""What ``/model`` tells of the weights' card."""


def expect_installed() -> None:
    """Refuse where the service's packages are not installed."""
    for name in ("starlette", "uvicorn"):
        expect_library(name, "serve", "the service")


@dataclass(frozen=True)
class Query:
    """The options of a request."""

    format: str = ""
    """Of the body; empty for what its content type or its beginning says."""
    fields: str = ""
    """Names of the columns, as x,y,z,intensity,ring."""
    frame: str = ""
    """Name of the sweep, handed back."""
    score_threshold: float = 0.0
    """Leave out detections below this score."""

    @classmethod
    def parse(cls, given: Mapping[str, str]) -> Query:
        """Read the words behind the question mark.

        Raises:
            BeamboxError: for an option that is not known, or a value that it cannot have.
        """
        known = [*cls.__dataclass_fields__]
        for name, value in given.items():
            if name not in known:
                raise BeamboxError(f"there is no option {name[:40]!a}{did_you_mean(name, known)}")
            if len(value) > 400:
                raise BeamboxError(f"`{name}` has {len(value)} characters, allowed 400")
        if given.get("frame"):
            check_file_name(given["frame"], "`frame`")
        word = given.get("score_threshold", "0")
        try:
            score = float(word)
        except ValueError:
            score = math.nan
        if not 0 <= score <= 1:
            raise BeamboxError(f"`score_threshold` must be a number from 0 to 1, got {word[:40]!a}")
        return cls(given.get("format", ""), given.get("fields", ""), given.get("frame", ""), score)


class Service:
    """A detector, the requests in work, and what they may cost."""

    def __init__(
        self, detector: Detector, model: str, limits: ServeLimits, batch_size: int = 4, batch_wait: float = 0.005
    ) -> None:
        self.detector, self.model, self.limits = detector, model, limits
        self.batcher = Batcher(detector.detect, batch_size, batch_wait)
        self.in_work = 0
        self._readers = ThreadPoolExecutor(READERS, thread_name_prefix="beambox-read")
        self._folder = tempfile.TemporaryDirectory(prefix="beambox-serve-")

    async def stop(self) -> None:
        """End the detector's thread and remove the folder."""
        await self.batcher.stop()
        self._readers.shutdown(wait=True, cancel_futures=True)
        self._folder.cleanup()

    async def detect(self, request: Request) -> str:
        """Answer a request with JSON.

        Raises:
            RequestError: for what the sender can mend, or has to try again.
        """
        query = Query.parse(request.query_params)
        if self.in_work >= self.limits.max_waiting:
            raise RequestError(503, f"{self.in_work} requests are in work already; try again in a moment")
        self.in_work += 1
        try:
            content = await self._receive(request)
            try:
                return await asyncio.wait_for(self._answer(content, request, query), self.limits.answer_seconds)
            except (asyncio.TimeoutError, TimeoutError):
                raise RequestError(
                    503, f"no answer within {self.limits.answer_seconds:g} s; try again, or send fewer at a time"
                ) from None
        finally:
            self.in_work -= 1

    async def _receive(self, request: Request) -> bytes:
        """Take the body, as far as it may go."""
        too_large = f"the body is larger than {self.limits.max_bytes / 1e6:.0f} MB"
        if request.headers.get("content-encoding", "identity").lower() != "identity":
            raise RequestError(415, "expected the body as it is, without a Content-Encoding")
        length = request.headers.get("content-length", "")
        if length.isdecimal() and (len(length) > 18 or int(length) > self.limits.max_bytes):
            raise RequestError(413, too_large)

        async def chunks() -> bytes:
            content = bytearray()
            async for chunk in request.stream():
                content += chunk
                if len(content) > self.limits.max_bytes:
                    raise RequestError(413, too_large)
            return bytes(content)

        try:
            return await asyncio.wait_for(chunks(), self.limits.body_seconds)
        except (asyncio.TimeoutError, TimeoutError):
            raise RequestError(408, f"the body did not arrive within {self.limits.body_seconds:g} s") from None

    async def _answer(self, content: bytes, request: Request, query: Query) -> str:
        content_type = request.headers.get("content-type", "").partition(";")[0]
        sweep = await self._read(content, choose_format(query.format, content_type, content), query.fields)
        try:
            found = await self.batcher.submit(sweep)
        except BeamboxError as error:
            raise RequestError(400, str(error)) from error
        return replace(found.above(query.score_threshold), frame_id=query.frame).to_json(self.model)

    async def _read(self, content: bytes, kind: str, fields: str) -> Frame:
        columns = fields or self.detector.fields
        columns = columns if columns is None or isinstance(columns, str) else ",".join(columns)
        folder, scale = Path(self._folder.name), self.detector.intensity_scale
        reading = functools.partial(read_body, content, kind, folder, self.limits, columns, scale)
        return await asyncio.get_running_loop().run_in_executor(self._readers, reading)

    def about(self) -> dict[str, Any]:
        """Return what ``/model`` answers."""
        detector, limits = self.detector, self.limits
        return {
            "model": self.model,
            "beambox": __version__,
            "classes": list(detector.classes),
            "range": {"minimum": list(detector.grid.minimum), "maximum": list(detector.grid.maximum)},
            "num_point_features": detector.config.num_point_features,
            "device": str(detector.device),
            "precision": str(detector.dtype).removeprefix("torch."),
            "formats": list(FORMATS),
            "batch_size": self.batcher.size,
            "limits": {"bytes": limits.max_bytes, "points": limits.max_points, "waiting": limits.max_waiting},
            "card": {key: detector.card[key] for key in TOLD if key in detector.card},
        }

    def health(self) -> dict[str, Any]:
        """Return what ``/health`` answers."""
        return {
            "status": "ok" if self.batcher.running else "stopped",
            "in_work": self.in_work,
            "batches": self.batcher.batches,
            "sweeps": self.batcher.frames,
        }


def create_app(
    detector: Detector,
    model: str,
    limits: ServeLimits | None = None,
    *,
    batch_size: int = 4,
    batch_wait: float = 0.005,
) -> Starlette:
    """Make the application.

    Args:
        detector: what answers; calibrations do not travel with a sweep, so the full view is looked at.
        model: what answers call it.
        limits: of a request.
        batch_size: requests that go through the network together at most.
        batch_wait: seconds that the first waits for others.

    Raises:
        BeamboxError: if the extra `serve` is not installed.
    """
    expect_installed()
    from starlette.applications import Starlette
    from starlette.responses import JSONResponse, Response
    from starlette.routing import Route

    def service(request: Request) -> Service:
        return request.app.state.service

    async def detect(request: Request) -> Response:
        return Response(await service(request).detect(request), media_type="application/json")

    async def health(request: Request) -> Response:
        details = service(request).health()
        return JSONResponse(details, 200 if details["status"] == "ok" else 503)

    async def about(request: Request) -> Response:
        return JSONResponse(service(request).about())

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        app.state.service = Service(detector, model, limits or ServeLimits(), batch_size, batch_wait)
        app.state.service.batcher.start()
        try:
            yield
        finally:
            await app.state.service.stop()

    routes = [
        Route("/detect", detect, methods=["POST"]),
        Route("/health", health, methods=["GET"]),
        Route("/model", about, methods=["GET"]),
    ]
    return Starlette(routes=routes, lifespan=lifespan, exception_handlers=error_answers())


def error_answers() -> dict[Any, Any]:
    """Return what answers each kind of error with ``{"error": "one line"}``; faults of ours tell nothing else."""
    from starlette.exceptions import HTTPException
    from starlette.requests import ClientDisconnect
    from starlette.responses import JSONResponse, Response

    def answer(status: int, message: str) -> Response:
        headers = {"Retry-After": "1"} if status == 503 else {}
        if status in (408, 413):
            headers["Connection"] = "close"  # the rest of the body is not waited for
        return JSONResponse({"error": printable(" ".join(message.split()), LONGEST_MESSAGE)}, status, headers)

    async def refused(_: Request, error: Exception) -> Response:
        return answer(error.status if isinstance(error, RequestError) else 400, str(error))

    async def unknown(_: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        return answer(error.status_code, f"{error.detail}; there are POST /detect, GET /health and GET /model")

    async def gone(_: Request, error: Exception) -> Response:
        return answer(400, "the sender has gone")  # nobody reads it

    async def internal(_: Request, error: Exception) -> Response:
        return answer(500, "internal error; the log of the service has the details")

    return {BeamboxError: refused, HTTPException: unknown, ClientDisconnect: gone, Exception: internal}

"""The service: answers as `beambox detect` writes them, and a thousand hostile requests that change nothing."""

from __future__ import annotations

import asyncio
import io
import json
import random
import struct
import zipfile
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

httpx = pytest.importorskip("httpx")
pytest.importorskip("starlette")

from beambox.checks import BeamboxError
from beambox.infer.predictor import Detector
from beambox.serve.app import create_app
from beambox.serve.batching import Batcher
from beambox.serve.bodies import unpacked_size
from beambox.serve.limits import ServeLimits
from beambox.structures import Detections, Frame
from oracles.same_boxes import expect_same_boxes
from oracles.tiny_detector import street, tiny_model

LIMITS = ServeLimits(max_bytes=400_000, max_points=20_000, max_unpacked=2_000_000, body_seconds=0.3)
SWEEP = street()


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector(tiny_model(), device="cpu", precision="float32")


def served(
    detector: Any, talk: Callable[[Any, Any], Awaitable[None]], limits: ServeLimits = LIMITS, **options: Any
) -> None:
    """Run the application and a conversation with it."""

    async def run() -> None:
        app = create_app(detector, "tiny", limits, **options)
        transport = httpx.ASGITransport(app)  # hands on what the application raises
        async with app.router.lifespan_context(app):
            async with httpx.AsyncClient(transport=transport, base_url="http://test") as client:
                await talk(client, app.state.service)

    asyncio.run(run())


# --- good requests ----------------------------------------------------------------------------------------------------


def test_every_format_gives_what_detecting_in_the_array_gives(detector: Detector) -> None:
    packed, plain = io.BytesIO(), io.BytesIO()
    np.savez_compressed(packed, points=SWEEP)
    np.save(plain, SWEEP)
    bodies = {"bin": SWEEP.tobytes(), "npy": plain.getvalue(), "npz": packed.getvalue(), "ply": ply(SWEEP)}
    types = {"npy": "application/x-npy", "npz": "application/x-npz", "ply": "model/ply"}
    wanted = detector(SWEEP)

    async def talk(client: Any, _: Any) -> None:
        for kind, body in bodies.items():
            asked = await client.post(f"/detect?format={kind}&frame=000007", content=body)
            by_type = await client.post("/detect", content=body, headers={"content-type": types.get(kind, "")})
            guessed = await client.post("/detect", content=body)
            for answer in (asked, by_type, guessed):
                assert answer.status_code == 200 and answer.headers["content-type"] == "application/json", answer.text
                found = Detections.from_json(answer.text)
                expect_same_boxes(found, wanted, 2e-4)
            assert asked.json()["frame"] == "000007" and asked.json()["model"] == "tiny"

    served(detector, talk)


def ply(points: np.ndarray) -> bytes:
    pytest.importorskip("plyfile")
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{names}end_header\n"
    return head.encode() + points.tobytes()


def test_options_of_the_query(detector: Detector) -> None:
    wide = np.concatenate((SWEEP, np.ones((len(SWEEP), 1), np.float32)), axis=1)

    async def talk(client: Any, _: Any) -> None:
        least = await client.post("/detect?score_threshold=0.5", content=SWEEP.tobytes())
        scores = [row["score"] for row in least.json()["detections"]]
        assert scores and min(scores) >= 0.5
        five = await client.post("/detect?fields=x,y,z,intensity,ring&score_threshold=0.5", content=wide.tobytes())
        assert five.json()["detections"] == least.json()["detections"]
        refused = await client.post("/detect", content=wide.tobytes())
        assert refused.status_code == 400 and "looks like points of 5 float32" in refused.json()["error"]
        for query, words in {
            "score_threshold=nan": "from 0 to 1", "score_threshold=2": "from 0 to 1", "score_threshold=": "from 0 to 1",
            "score_treshold=1": "did you mean", "format=exe": "must be one of bin, npy",
            "frame=../a": "separator of folders", "fields=a,b": "must name x, y and z",
            "frame=" + "a" * 401: "401 characters",
        }.items():  # fmt: skip
            answer = await client.post(f"/detect?{query}", content=SWEEP.tobytes())
            assert 400 <= answer.status_code < 500 and words in answer.json()["error"], answer.text

    served(detector, talk)


def test_empty_sweeps_and_sweeps_elsewhere_have_no_detections(detector: Detector) -> None:
    async def talk(client: Any, _: Any) -> None:
        for points in (SWEEP[:3] + 1000, np.full((5, 4), np.nan, np.float32)):
            answer = await client.post("/detect?format=bin&fields=x,y,z,intensity", content=points.tobytes())
            assert answer.status_code == 200 and answer.json()["detections"] == []

    served(detector, talk)


def test_what_it_tells_of_itself(detector: Detector) -> None:
    async def talk(client: Any, _: Any) -> None:
        await client.post("/detect", content=SWEEP.tobytes())
        health, model = (await client.get("/health")).json(), (await client.get("/model")).json()
        assert health == {"status": "ok", "in_work": 0, "batches": 1, "sweeps": 1}
        assert model["classes"] == ["Car", "Pedestrian", "Cyclist"] and model["limits"]["bytes"] == 400_000
        assert model["range"]["maximum"] == [32.0, 16.0, 1.0] and model["precision"] == "float32"
        for method, path, status in (("GET", "/detect", 405), ("POST", "/health", 405), ("GET", "/", 404)):
            answer = await client.request(method, path)
            assert answer.status_code == status and "there are POST /detect" in answer.json()["error"]

    served(detector, talk)


# --- batches and load -------------------------------------------------------------------------------------------------


def test_requests_of_one_moment_go_through_together_and_each_gets_its_own_answer(detector: Detector) -> None:
    sweeps = [street(seed) for seed in range(6)]
    wanted = [detector(points) for points in sweeps]

    async def talk(client: Any, service: Any) -> None:
        posts = [client.post(f"/detect?frame=s{k}", content=points.tobytes()) for k, points in enumerate(sweeps)]
        answers = await asyncio.gather(*posts)
        for k, answer in enumerate(answers):
            assert answer.json()["frame"] == f"s{k}"
            expect_same_boxes(Detections.from_json(answer.text), wanted[k], 2e-3)
        assert service.batcher.frames == 6 and service.batcher.batches <= 3

    served(detector, talk, batch_size=4, batch_wait=2.0)


def test_one_bad_frame_does_not_spoil_its_batch() -> None:
    def detect(frames: Sequence[Frame]) -> list[Detections]:
        if any(frame.id == "bad" for frame in frames):
            raise BeamboxError("this one is bad")
        return [Detections.empty(("Car",), frame.id) for frame in frames]

    async def run() -> None:
        batcher = Batcher(detect, size=3, wait=0.5)
        batcher.start()
        frames = [Frame(SWEEP[:1], name) for name in ("a", "bad", "c")]
        answers = await asyncio.gather(*map(batcher.submit, frames), return_exceptions=True)
        assert isinstance(answers[1], BeamboxError)
        assert [one.frame_id for one in answers[::2] if isinstance(one, Detections)] == ["a", "c"]
        assert batcher.running
        await batcher.stop()

    asyncio.run(run())


class Fake:
    """What the service needs of a detector, with a network of our choice."""

    def __init__(self, detector: Detector, detect: Callable[[Sequence[Frame]], list[Detections]]) -> None:
        self._of, self.detect = detector, detect

    def __getattr__(self, name: str) -> Any:
        return getattr(self._of, name)


def test_a_full_service_says_so_at_once_and_a_late_answer_is_refused(detector: Detector) -> None:
    import threading

    go_on = threading.Event()

    def slow(frames: Sequence[Frame]) -> list[Detections]:
        go_on.wait(10)
        return [Detections.empty(("Car",)) for _ in frames]

    async def talk(client: Any, service: Any) -> None:
        body = SWEEP.tobytes()
        posts = [asyncio.create_task(client.post("/detect", content=body)) for _ in range(3)]
        while service.in_work < 3:
            await asyncio.sleep(0.01)
        full = await client.post("/detect", content=body)
        assert full.status_code == 503 and "try again" in full.json()["error"] and full.headers["retry-after"] == "1"
        late = [answer.status_code for answer in await asyncio.gather(*posts)]
        assert late == [503] * 3 and service.in_work == 0
        go_on.set()
        assert (await client.post("/detect", content=body)).status_code == 200

    served(Fake(detector, slow), talk, ServeLimits(max_waiting=3, answer_seconds=0.5))


def test_faults_of_ours_tell_nothing(detector: Detector) -> None:
    def broken(frames: Sequence[Frame]) -> list[Detections]:
        raise RuntimeError("secret /home/somebody")

    async def run() -> None:
        app = create_app(Fake(detector, broken), "tiny", LIMITS)  # pyright: ignore[reportArgumentType]
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with app.router.lifespan_context(app), httpx.AsyncClient(transport=transport) as client:
            answer = await client.post("http://test/detect", content=SWEEP.tobytes())
            assert answer.status_code == 500
            assert answer.json() == {"error": "internal error; the log of the service has the details"}
            assert (await client.get("http://test/health")).json()["status"] == "ok"

    asyncio.run(run())


# --- limits -----------------------------------------------------------------------------------------------------------


def bomb() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", bytes(3_000_000))
    return stream.getvalue()


def packed_pcd(size: int) -> bytes:
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 9\nHEIGHT 1\nPOINTS 9\nDATA binary_compressed\n"
    return head.encode() + struct.pack("<II", 20, size) + bytes(20)


def test_what_is_too_large_is_refused_before_it_takes_room(detector: Detector) -> None:
    assert unpacked_size(packed_pcd(77), "pcd") == 77 and unpacked_size(bomb(), "npz") == 3_000_000
    many = np.zeros((20_001, 4), np.float32).tobytes()
    cases = [
        (bytes(400_001), {}, 413, "larger than 0 MB"),
        (many, {}, 413, "20,001 points, allowed 20,000"),
        (bomb(), {}, 413, "would unpack to 3 MB"),
        (packed_pcd(1 << 31), {}, 413, "would unpack to 2147 MB"),
        (SWEEP.tobytes(), {"content-encoding": "gzip"}, 415, "without a Content-Encoding"),
        (b"x", {"content-length": "9" * 30}, 413, "larger than"),
    ]

    async def endless() -> AsyncIterator[bytes]:
        while True:
            yield bytes(50_000)

    async def talk(client: Any, _: Any) -> None:
        for body, headers, status, words in cases:
            answer = await client.post("/detect", content=body, headers=headers)
            assert answer.status_code == status and words in answer.json()["error"], answer.text
        assert (await client.post("/detect", content=endless())).status_code == 413

    served(detector, talk)


def test_without_the_extra_it_says_what_to_install(detector: Detector, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(BeamboxError, match=r'the service needs the library starlette, .*pip install "\.\[serve\]"'):
        create_app(detector, "tiny")
    with pytest.raises(BeamboxError, match="`max_bytes` must be above 0, got 0"):
        ServeLimits(max_bytes=0)


# --- hostile requests -------------------------------------------------------------------------------------------------

TRICKS = (
    "../../etc/passwd",
    "/etc/passwd",
    "..%2f..%2fx",
    "C:\\x",
    "a\0b",
    "\x1b[2J",
    "%00",
    "con",
    "~",
    "a" * 5000,
    "\u202e",
)
PATHS = (
    "/detect",
    "/detect/",
    "/detect/../../etc/passwd",
    "//detect",
    "/health",
    "/model",
    "/%2e%2e/%2e%2e/x",
    "/docs",
)
TYPES = (
    "",
    "application/json",
    "multipart/form-data; boundary=x",
    "text/html",
    "application/x-npy",
    "a" * 3000,
    "model/ply",
)


def mutated(rng: random.Random, good: list[bytes]) -> bytes:
    """Return a body that is nearly a sweep, or nothing like one."""
    body = bytearray(rng.choice(good))
    kind = rng.randrange(9)
    if kind == 0:
        return bytes(body[: rng.randrange(len(body))])
    if kind == 1:
        for _ in range(rng.randrange(1, 30)):
            body[rng.randrange(min(len(body), 400))] = rng.randrange(256)
    elif kind == 2:
        return rng.randbytes(rng.randrange(3000))
    elif kind == 3:
        depth = rng.randrange(1, 50_000)
        return b"[" * depth + b"]" * depth
    elif kind == 4:
        values = [np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-45, 0.0, 5.0]
        return np.array([rng.choices(values, k=4) for _ in range(rng.randrange(1, 400))], np.float32).tobytes()
    elif kind == 5:
        return bytes(rng.randrange(390_000, 500_000))
    elif kind == 6:
        return json.dumps({"points": "../../etc/passwd", "n": [1] * rng.randrange(100)}).encode()
    elif kind == 7:
        return rng.choice(
            [
                bomb(),
                packed_pcd(rng.randrange(1 << 32)),
                b"PK\x03\x04",
                b"\x93NUMPY\x01\x00\xff\xff",
                b"LASF" + bytes(400),
            ]
        )
    return bytes(body) + rng.randbytes(rng.randrange(1, 7))


async def slowly(body: bytes) -> AsyncIterator[bytes]:
    for k in range(0, len(body), 10_000):
        yield body[k : k + 10_000]
        await asyncio.sleep(0.1)


def test_a_thousand_hostile_requests_change_nothing(detector: Detector) -> None:
    rng = random.Random(0)
    plain = io.BytesIO()
    np.save(plain, SWEEP[:300])
    packed = io.BytesIO()
    np.savez(packed, x=SWEEP[:300, 0], y=SWEEP[:300, 1], z=SWEEP[:300, 2])
    good = [SWEEP[:300].tobytes(), plain.getvalue(), packed.getvalue(), packed_pcd(108), ply(SWEEP[:300])]
    statuses: Counter[int] = Counter()

    async def one(client: Any, number: int) -> None:
        query = {}
        if rng.random() < 0.5:
            query["format"] = rng.choice(["bin", "npy", "npz", "pcd", "ply", "las", "laz", *TRICKS])
        if rng.random() < 0.2:
            query[rng.choice(["frame", "fields", "score_threshold", *TRICKS[:3]])] = rng.choice(TRICKS)
        headers = {"content-type": rng.choice(TYPES)} if rng.random() < 0.5 else {}
        body: Any = mutated(rng, good)
        path = rng.choice(PATHS) if rng.random() < 0.2 else "/detect"
        method = rng.choice(["GET", "PUT", "DELETE", "TRACE"]) if rng.random() < 0.05 else "POST"
        if number % 50 == 0:
            body = slowly(SWEEP.tobytes())
        answer = await client.request(method, path, params=query, content=body, headers=headers)
        statuses[answer.status_code] += 1
        assert answer.status_code in (200, 307, 400, 404, 405, 408, 413, 415), answer.text
        text = answer.text
        assert len(text) < 100_000 and "Traceback" not in text and "beambox-serve-" not in text and "root:" not in text
        if answer.status_code not in (200, 307):
            told = answer.json()["error"]
            assert list(answer.json()) == ["error"] and "\n" not in told and told.isprintable() and len(told) <= 1100

    async def talk(client: Any, service: Any) -> None:
        before = await client.post("/detect", content=SWEEP.tobytes())
        folder = Path(service._folder.name)
        for start in range(0, 1000, 10):  # ten at a time
            await asyncio.gather(*(one(client, number) for number in range(start, start + 10)))
        assert statuses.total() == 1000 and {200, 400, 404, 405, 408, 413, 415} <= statuses.keys(), statuses
        assert list(folder.iterdir()) == [] and service.in_work == 0
        after = await client.post("/detect", content=SWEEP.tobytes())
        assert after.status_code == 200 and after.text == before.text
        assert (await client.get("/health")).json()["status"] == "ok"

    served(detector, talk)

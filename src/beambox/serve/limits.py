"""What one request may cost, and the errors that say so."""

from __future__ import annotations

from dataclasses import dataclass, fields

from beambox.checks import BeamboxError

__all__ = ["RequestError", "ServeLimits"]


class RequestError(BeamboxError):
    """A request that is refused; ``status`` is the HTTP status."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class ServeLimits:
    """Limits of the service; all are above 0."""

    max_bytes: int = 32 << 20
    """Bytes of a body; a KITTI sweep has 2 MB, one of 128 beams 4 MB."""
    max_unpacked: int = 256 << 20
    """Bytes that a compressed format (.npz, .laz, compressed .pcd) may grow to."""
    max_points: int = 1_000_000
    """Points of a sweep."""
    body_seconds: float = 20.0
    """Time for a body to arrive."""
    answer_seconds: float = 60.0
    """Time from the last byte of a body to the answer."""
    max_waiting: int = 16
    """Requests in work at a time, bodies being received included; more are refused at once."""
    max_connections: int = 128
    """Open connections."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not value > 0:
                raise BeamboxError(f"`{field.name}` must be above 0, got {value}")

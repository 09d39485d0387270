"""Casts the beams of a sensor into a scene of convex parts over a height field; compiled with numba.

Every beam tests only the objects whose azimuth interval covers its column and whose elevation interval covers it. All
randomness inside is a hash of (seed, beam, part), so the result depends on neither threads nor order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numba
import numpy as np

from beambox.simulate.ellipsoids import NO_HIT, hit_ellipsoid
from beambox.simulate.ground import ground_height, ground_surface
from beambox.simulate.shapes import Shape, rotation

__all__ = ["Hits", "Placed", "cast", "pack"]

_TILT_MARGIN = 0.15  # metres added around footprints, for objects that lean


@dataclass(frozen=True)
class Placed:
    """A shape at a place in the LiDAR frame."""

    shape: Shape
    """What stands there."""
    position: tuple[float, float, float]
    """Where the shape's origin (on the ground, in its middle) lies, metres."""
    yaw: float
    """Heading, radians."""
    pitch: float = 0.0
    """Nose down, radians."""
    roll: float = 0.0
    """Left side up, radians."""
    name: str = ""
    """Class of the object; empty for scenery, which gets no label."""
    box: tuple[float, ...] = field(default=())
    """x, y, z, l, w, h, yaw of the label, for objects."""


@dataclass(frozen=True)
class Hits:
    """What every beam met, (beams * columns,) each, and how many beams each object would have got alone."""

    distance: np.ndarray
    """Metres from where the beam leaves; infinity where it met nothing."""
    owner: np.ndarray
    """Index of the object, -1 for the ground, -2 for nothing."""
    material: np.ndarray
    """Row of the palette."""
    cosine: np.ndarray
    """Cosine of the incidence."""
    unoccluded_hits: np.ndarray
    """(O,) beams that would meet the object were it alone over the ground."""
    hits: np.ndarray
    """(O,) beams that do meet it."""


_Packed = tuple[np.ndarray, ...]


def pack(placed: Sequence[Placed], origins: tuple[float, float]) -> _Packed:
    """Carry all shapes into the LiDAR frame and lay them out in flat arrays.

    Args:
        placed: the objects.
        origins: lowest and highest z at which beams leave.

    Returns:
        planes (F, 4), plane materials (F,), ellipsoids (E, 3, 3), parts (P, 9), first part of each object (O + 1,),
        patches (Q, 7), first patch of each object (O + 1,), poses (O, 12: rotation then translation), reaches (O, 6:
        lowest and highest x, y, z in the object's frame), bounds (O, 6: azimuth centre, azimuth half-width, lowest and
        highest tangent of elevation, nearest distance, labelled).
    """
    count = len(placed)
    turn = np.array([rotation(p.yaw, p.pitch, p.roll) for p in placed]).reshape(count, 3, 3)
    shift = np.array([p.position for p in placed], dtype=np.float64).reshape(count, 3)
    shapes = [p.shape for p in placed]

    def rows(name_rows: list[list], width: int) -> tuple[np.ndarray, np.ndarray]:
        counts = np.array([len(r) for r in name_rows], dtype=np.int64)
        flat = [row for r in name_rows for row in r]
        return np.array(flat, dtype=np.float64).reshape(len(flat), width), counts

    planes, plane_count = rows([s.planes for s in shapes], 5)
    owner = np.repeat(np.arange(count), plane_count)
    normal = np.einsum("fij,fj->fi", turn[owner], planes[:, :3])
    reach = planes[:, 3] + np.einsum("fi,fi->f", normal, shift[owner])
    ellipsoids, ellipsoid_count = rows([s.ellipsoids for s in shapes], 9)
    owner = np.repeat(np.arange(count), ellipsoid_count)
    matrices = ellipsoids.reshape(-1, 3, 3) @ turn[owner].transpose(0, 2, 1)
    parts, part_count = rows([s.parts for s in shapes], 9)
    owner = np.repeat(np.arange(count), part_count)
    parts[:, 3:6] = np.einsum("pij,pj->pi", turn[owner], parts[:, 3:6]) + shift[owner]
    starts = [np.concatenate(([0], np.cumsum(c))) for c in (plane_count, ellipsoid_count, part_count)]
    is_ellipsoid = parts[:, 0] > 0.5
    base = np.where(is_ellipsoid, starts[1][owner], starts[0][owner])
    parts[:, 1:3] += base[:, None]
    patches, patch_count = rows([s.patches for s in shapes], 7)
    return (
        np.ascontiguousarray(np.concatenate((normal, reach[:, None]), axis=1)),
        planes[:, 4].astype(np.int64),
        np.ascontiguousarray(matrices),
        parts,
        starts[2],
        patches,
        np.concatenate(([0], np.cumsum(patch_count))),
        np.concatenate((turn.reshape(count, 9), shift), axis=1),
        np.array([[*s.low, *s.high] for s in shapes]).reshape(count, 6),
        _bounds(placed, shift, origins),
    )


def _bounds(placed: Sequence[Placed], shift: np.ndarray, origins: tuple[float, float]) -> np.ndarray:
    low = np.array([p.shape.low for p in placed]).reshape(-1, 3) - _TILT_MARGIN
    high = np.array([p.shape.high for p in placed]).reshape(-1, 3) + _TILT_MARGIN
    yaw = np.array([p.yaw for p in placed])
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x = np.stack((low[:, 0], low[:, 0], high[:, 0], high[:, 0]), axis=1)  # (O, 4)
    y = np.stack((low[:, 1], high[:, 1], high[:, 1], low[:, 1]), axis=1)
    wx, wy = c * x - s * y + shift[:, :1], s * x + c * y + shift[:, 1:2]
    ox, oy = -(c[:, 0] * shift[:, 0] + s[:, 0] * shift[:, 1]), s[:, 0] * shift[:, 0] - c[:, 0] * shift[:, 1]
    dx = np.maximum(np.maximum(low[:, 0] - ox, ox - high[:, 0]), 0)
    dy = np.maximum(np.maximum(low[:, 1] - oy, oy - high[:, 1]), 0)
    near, far = np.hypot(dx, dy), np.hypot(wx, wy).max(axis=1, initial=0.0)
    middle = np.arctan2(wy.mean(axis=1), wx.mean(axis=1))
    offset = np.arctan2(wy, wx) - middle[:, None]
    offset -= 2 * np.pi * np.round(offset / (2 * np.pi))
    lo, hi = offset.min(axis=1, initial=9.0), offset.max(axis=1, initial=-9.0)
    around = (near < 0.3) | (hi - lo > math.pi)
    half = np.where(around, 4.0, (hi - lo) / 2)
    bottom, top = low[:, 2] + shift[:, 2] - origins[1], high[:, 2] + shift[:, 2] - origins[0]
    close = np.maximum(near, 0.05)
    tan_low = np.where(bottom < 0, bottom / close, bottom / far)
    tan_high = np.where(top > 0, top / close, top / far)
    labeled = np.array([float(bool(p.name)) for p in placed])
    return np.stack((middle + (lo + hi) / 2, half, tan_low, tan_high, near, labeled), axis=1)


@numba.njit(cache=True, nogil=True)
def _uniform(seed: np.uint64, a: int, b: int) -> float:
    """A number in [0, 1) that depends on its arguments alone (splitmix64)."""
    z = seed + np.uint64(a) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(b) * np.uint64(0xD1B54A32D192ED03)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) / 9007199254740992.0


@numba.njit(cache=True, nogil=True)
def _columns(bounds: np.ndarray, azimuths: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Objects of each column, near ones first: starts (C + 1,) and indices."""
    order = np.argsort(bounds[:, 4], kind="mergesort")
    start = np.zeros(len(azimuths) + 1, np.int64)
    for c in range(len(azimuths)):
        for o in order:
            away = azimuths[c] - bounds[o, 0]
            away -= 2 * math.pi * round(away / (2 * math.pi))
            if abs(away) <= bounds[o, 1] + margin:
                start[c + 1] += 1
    start = np.cumsum(start)
    index = np.empty(start[-1], np.int64)
    for c in range(len(azimuths)):
        k = start[c]
        for o in order:
            away = azimuths[c] - bounds[o, 0]
            away -= 2 * math.pi * round(away / (2 * math.pi))
            if abs(away) <= bounds[o, 1] + margin:
                index[k] = o
                k += 1
    return start, index


@numba.njit(cache=True, nogil=True)
def _hit_ground(g: np.ndarray, oz: float, dx: float, dy: float, dz: float, limit: float) -> float:
    """Distance at which a beam meets the ground, or NO_HIT: regula falsi on the height above it."""
    low, f_low, high, f_high = 0.0, oz - ground_height(g, 0.0, 0.0), -1.0, 0.0
    if f_low <= 0:
        return NO_HIT
    fall = g[1] * dx + g[2] * dy - dz
    t = f_low / max(fall, 0.004)
    for step in range(40):
        if high < 0 and t > limit:
            if low >= limit - 1e-6:
                return NO_HIT
            t = limit
        f = oz + dz * t - ground_height(g, dx * t, dy * t)
        if abs(f) < 0.002:
            return t
        if f > 0:
            low, f_low = t, f
        else:
            high, f_high = t, f
        if high < 0:
            t = low + max(f_low / max(fall, 0.004) * 0.7, 0.5)
        elif step % 3 == 2:
            t = 0.5 * (low + high)
        else:
            t = low + (high - low) * f_low / (f_low - f_high)
        if high >= 0 and high - low < 0.002:
            return high
    return high if high >= 0 else NO_HIT


@numba.njit(cache=True, nogil=True)
def _hit_part(
    part: np.ndarray,
    planes: np.ndarray,
    plane_material: np.ndarray,
    ellipsoids: np.ndarray,
    table: np.ndarray,
    ray: tuple[float, float, float, float],
    chance: tuple[np.uint64, int, int],
) -> tuple[float, int, float]:
    """Distance at which a beam meets a part, its material, and the cosine of incidence; distance NO_HIT for a miss."""
    oz, dx, dy, dz = ray
    cx, cy, cz = part[3], part[4], part[5] - oz
    along = cx * dx + cy * dy + cz * dz
    if cx * cx + cy * cy + cz * cz - along * along > part[6] * part[6] or along < -part[6]:
        return NO_HIT, 0, 0.0
    first, last = int(part[1]), int(part[2])
    enter, leave, face_in, face_out, cos_in, cos_out = 0.0, NO_HIT, int(part[8]), int(part[8]), 1.0, 1.0
    if part[0] > 0.5:
        enter, leave, cos_in = hit_ellipsoid(ellipsoids[first], cx, cy, cz, dx, dy, dz)
        if enter == NO_HIT:
            return NO_HIT, 0, 0.0
    else:
        enter = -NO_HIT
        for f in range(first, last):
            slope = planes[f, 0] * dx + planes[f, 1] * dy + planes[f, 2] * dz
            away = planes[f, 3] - planes[f, 2] * oz
            if abs(slope) < 1e-12:
                if away < 0:
                    return NO_HIT, 0, 0.0
                continue
            t = away / slope
            if slope < 0:
                if t > enter:
                    enter, face_in, cos_in = t, plane_material[f], -slope
            elif t < leave:
                leave, face_out, cos_out = t, plane_material[f], slope
            if enter > leave:
                return NO_HIT, 0, 0.0
    if enter <= 0 or leave <= enter:
        return NO_HIT, 0, 0.0
    seed, beam, number = chance
    if part[7] > 0:
        depth = -math.log(1.0 - _uniform(seed, beam, 4 * number)) / part[7]
        t = enter + depth
        return (t, face_in, 0.3 + 0.7 * _uniform(seed, beam, 4 * number + 1)) if t < leave else (NO_HIT, 0, 0.0)
    if _uniform(seed, beam, 4 * number + 2) >= table[face_in, 5]:
        return enter, face_in, cos_in
    if _uniform(seed, beam, 4 * number + 3) >= table[face_out, 5]:
        return leave, face_out, cos_out
    return NO_HIT, 0, 0.0


@numba.njit(cache=True, nogil=True)
def _misses(pose: np.ndarray, reach: np.ndarray, oz: float, dx: float, dy: float, dz: float) -> bool:
    """Tell whether a beam passes the box around an object, in the object's own frame."""
    enter, leave = 0.0, NO_HIT
    for k in range(3):
        slope = pose[k] * dx + pose[3 + k] * dy + pose[6 + k] * dz
        start = -pose[k] * pose[9] - pose[3 + k] * pose[10] + pose[6 + k] * (oz - pose[11])
        if abs(slope) < 1e-12:
            if start < reach[k] or start > reach[3 + k]:
                return True
            continue
        a, b = (reach[k] - start) / slope, (reach[3 + k] - start) / slope
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return enter > leave


@numba.njit(cache=True, nogil=True)
def _patched(patches: np.ndarray, first: int, last: int, pose: np.ndarray, x: float, y: float, z: float) -> int:
    """Material of the patch that covers a point of an object, or -1."""
    px, py, pz = x - pose[9], y - pose[10], z - pose[11]
    u = pose[0] * px + pose[3] * py + pose[6] * pz
    v = pose[1] * px + pose[4] * py + pose[7] * pz
    w = pose[2] * px + pose[5] * py + pose[8] * pz
    for q in range(first, last):
        p = patches[q]
        if p[0] <= u <= p[1] and p[2] <= v <= p[3] and p[4] <= w <= p[5]:
            return int(p[6])
    return -1


@numba.njit(cache=True, nogil=True)
def _cast(packed, ground, table, seed, azimuths, phases, beams, limit, step, out) -> None:
    planes, plane_material, ellipsoids, parts, part_start, patches, patch_start, poses, reaches, bounds = packed
    distance, owner, material, cosine, unoccluded_hits, hits = out
    start, index = _columns(bounds, azimuths, step)
    for b in range(len(beams)):
        ce, se, oz = math.cos(beams[b, 0]), math.sin(beams[b, 0]), beams[b, 1]
        tangent = se / ce
        for c in range(len(azimuths)):
            beam = b * len(azimuths) + c
            azimuth = azimuths[c] + phases[b]
            dx, dy = ce * math.cos(azimuth), ce * math.sin(azimuth)
            best = _hit_ground(ground, oz, dx, dy, se, limit)
            floor = best
            who, what, cos = -2, 0, 1.0
            if best < NO_HIT:
                x, y = dx * best, dy * best
                who, what = -1, ground_surface(ground, x, y)
                h = ground_height(ground, x, y)
                rise = ground_height(ground, x + 0.1 * dx / ce, y + 0.1 * dy / ce) - h
                cos = min(max(-tangent + rise / 0.1, 0.01), 1.0)
                rough = ground_rough(ground, what) * -math.log(1.0 - _uniform(seed, beam, -1))
                best -= min(rough / max(cos, 0.05), 0.03 * best + 0.02)
            for k in range(start[c], start[c + 1]):
                o = index[k]
                if tangent < bounds[o, 2] or tangent > bounds[o, 3]:
                    continue
                labeled = bounds[o, 5] > 0.5
                if bounds[o, 4] > best * 1.001 and not labeled:
                    continue
                if _misses(poses[o], reaches[o], oz, dx, dy, se):
                    continue
                mine, my_material, my_cos = NO_HIT, 0, 1.0
                for p in range(part_start[o], part_start[o + 1]):
                    t, m, cosine_here = _hit_part(
                        parts[p], planes, plane_material, ellipsoids, table, (oz, dx, dy, se), (seed, beam, p)
                    )
                    if t < mine:
                        mine, my_material, my_cos = t, m, cosine_here
                if mine < floor and mine < limit:
                    unoccluded_hits[o] += 1
                if mine < best:
                    best, who, what, cos = mine, o, my_material, my_cos
            if who >= 0 and patch_start[who + 1] > patch_start[who]:
                other = _patched(patches, patch_start[who], patch_start[who + 1], poses[who], dx * best, dy * best,
                                 oz + se * best)  # fmt: skip
                what = other if other >= 0 else what
            if who >= 0 and best < limit:
                hits[who] += 1
            distance[beam], owner[beam], material[beam], cosine[beam] = best, who, what, cos


@numba.njit(cache=True, nogil=True)
def ground_rough(ground: np.ndarray, surface: int) -> float:
    """How far returns scatter upwards on a surface, metres."""
    return ground[9 + min(surface, 2)] if surface < 3 else ground[9]


def cast(
    packed: _Packed,
    ground: np.ndarray,
    table: np.ndarray,
    seed: int,
    azimuths: np.ndarray,
    phases: np.ndarray,
    beams: np.ndarray,
    limit: float,
    step: float,
) -> Hits:
    """Cast every beam at every azimuth.

    Args:
        packed: the objects, from :func:`pack`.
        ground: from ``Ground.pack``.
        table: ``(M, 7)`` from ``Palette.table``.
        seed: of the hashes inside.
        azimuths: ``(C,)`` radians.
        phases: ``(B,)`` radians added to the azimuths of each beam, at most a step.
        beams: ``(B, 2)`` elevation in radians and z at which the beam leaves in metres.
        limit: farthest distance, metres.
        step: radians between azimuths.

    Returns:
        The hits, beam by beam.
    """
    count, objects = len(beams) * len(azimuths), len(packed[-1])
    distance, owner = np.empty(count), np.empty(count, np.int64)
    material, cosine = np.empty(count, np.int64), np.empty(count)
    unoccluded_hits, hits = np.zeros(objects, np.int64), np.zeros(objects, np.int64)
    out = (distance, owner, material, cosine, unoccluded_hits, hits)
    _cast(packed, ground, table, np.uint64(seed), azimuths, phases, beams, limit, step, out)
    distance[(distance >= limit) | (owner == -2)] = np.inf
    return Hits(*out)

"""Neighbourhood attention as plain loops over pixels and neighbours."""

from __future__ import annotations

import numpy as np


def neighborhood_attention(q, k, v, bias, window=7):
    """Return softmax(q . k / sqrt(d) + bias) . v over the window of each pixel; all arguments are arrays."""
    out = np.zeros(q.shape)
    images, heads, height, width, depth = q.shape
    for b, h, i, j in np.ndindex(images, heads, height, width):
        top = min(max(i - window // 2, 0), height - window)
        left = min(max(j - window // 2, 0), width - window)
        neighbors = [(top + r, left + c) for r in range(window) for c in range(window)]
        logits = np.array([
            q[b, h, i, j] @ k[b, h, y, x] / np.sqrt(depth) + bias[h, y - i + window - 1, x - j + window - 1]
            for y, x in neighbors
        ])  # fmt: skip
        weights = np.exp(logits - logits.max())
        weights /= weights.sum()
        out[b, h, i, j] = sum(weight * v[b, h, y, x] for weight, (y, x) in zip(weights, neighbors))
    return out

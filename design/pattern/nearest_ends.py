"""The tour of strokes that always goes on to the nearest end that is left."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from design.pattern.tiling import Array, Index


@njit(cache=True)  # type: ignore[untyped-decorator]
def nearest_ends(points: Array, first: int) -> Index:
    """Return the tour by nearest ends from the stroke of end `first`; a grid of buckets finds the nearest."""
    n = len(points)
    low_x, low_y = points[:, 0].min(), points[:, 1].min()
    width = max(points[:, 0].max() - low_x, points[:, 1].max() - low_y, 1e-9)
    cells = max(1, int(math.sqrt(n / 2)))
    size = width / cells * (1 + 1e-12)
    bucket = np.empty(n, np.int64)
    head = np.zeros(cells * cells + 1, np.int64)
    for v in range(n):
        cx, cy = min(cells - 1, int((points[v, 0] - low_x) / size)), min(cells - 1, int((points[v, 1] - low_y) / size))
        bucket[v] = cy * cells + cx
        head[bucket[v] + 1] += 1
    for k in range(cells * cells):
        head[k + 1] += head[k]
    content = np.empty(n, np.int64)
    place = np.empty(n, np.int64)
    fill = head[:-1].copy()
    for v in range(n):
        place[v] = fill[bucket[v]]
        content[place[v]] = v
        fill[bucket[v]] += 1
    live = fill  # buckets shrink from their end as ends are used
    order = np.empty(n, np.int64)
    here = first
    for k in range(0, n, 2):
        order[k], order[k + 1] = here, here ^ 1
        for v in (here, here ^ 1):
            b = bucket[v]
            last = content[live[b] - 1]
            content[place[v]], content[live[b] - 1] = last, v
            place[last], place[v] = place[v], live[b] - 1
            live[b] -= 1
        at = here ^ 1
        cx, cy = bucket[at] % cells, bucket[at] // cells
        best, least = -1, np.inf
        ring = 0
        while ring <= cells and (best < 0 or (ring - 1) * size < least):
            for gy in range(cy - ring, cy + ring + 1):
                if gy < 0 or gy >= cells:
                    continue
                step = 1 if abs(gy - cy) == ring else max(1, 2 * ring)
                for gx in range(cx - ring, cx + ring + 1, step):
                    if gx < 0 or gx >= cells:
                        continue
                    b = gy * cells + gx
                    for m in range(head[b], live[b]):
                        v = content[m]
                        d = math.hypot(points[v, 0] - points[at, 0], points[v, 1] - points[at, 1])
                        if d < least:
                            least, best = d, v
            ring += 1
        here = best
    return order

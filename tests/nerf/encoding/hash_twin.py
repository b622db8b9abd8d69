"""The hash encoding once more, point by point in Python floats: slow, obvious, independent of the kernels."""

import itertools
import math

import numpy as np


def corners(point, level, layout):
    """[(row of the table, weight)] of the eight vertices around a point."""
    resolution, offset = layout.resolutions[level], layout.offsets[level]
    cells, fractions = [], []
    for x in point:
        x = min(max(float(x), 0.0), 1.0) * resolution
        cells.append(min(math.floor(x), resolution - 1))
        fractions.append(x - cells[-1])
    found = []
    for step in itertools.product((0, 1), repeat=3):
        vertex = [cell + up for cell, up in zip(cells, step, strict=True)]
        weight = math.prod(f if up else 1 - f for f, up in zip(fractions, step, strict=True))
        if layout.dense[level]:
            row = vertex[0] + (resolution + 1) * vertex[1] + (resolution + 1) ** 2 * vertex[2]
        else:
            row = (vertex[0] ^ vertex[1] * 2654435761 ^ vertex[2] * 805459861) % 2**layout.log2_table_size
        found.append((offset + row, weight))
    return found


def encode_mean(points, scales, table, layout, g_out):
    """(N, S, 3), (N, S) or None, (rows, F), (N, levels * F) -> features, mean weights, gradient of the table."""
    n, s, _ = points.shape
    out = np.zeros((n, layout.levels, layout.features))
    weights = np.zeros((n, layout.levels))
    g_table = np.zeros(table.shape)
    g_out = g_out.reshape(out.shape)
    for i, j, level in itertools.product(range(n), range(s), range(layout.levels)):
        strength = 1.0
        if scales is not None and scales[i, j] > 0:
            strength = math.erf(1 / (math.sqrt(8) * scales[i, j] * layout.resolutions[level]))
        weights[i, level] += strength / s
        for row, weight in corners(points[i, j], level, layout):
            out[i, level] += strength * weight / s * table[row]
            g_table[row] += strength * weight / s * g_out[i, level]
    return out.reshape(n, -1), weights, g_table

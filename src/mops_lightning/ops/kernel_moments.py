"""Moments of neighbourhoods, compiled by numba for ``ops.moments``."""

# mypy: disable-error-code="no-untyped-def"

from mops_lightning.ops.jit import jit_cached


@jit_cached
def moments(points, centres, rows, out):
    """Write the means of o = p − c, and of the products of its coordinates.

    Args:
        points: ``(B, N, 3)`` the points p.
        centres: ``(B, M, 3)`` the centres c.
        rows: ``(B, M, k)`` int64, the neighbours of every centre.
        out: ``(B, M, 12)``: three means, then nine means of products.
    """
    clouds, m, k = rows.shape
    for cloud in range(clouds):
        for i in range(m):
            cx, cy, cz = centres[cloud, i, 0], centres[cloud, i, 1], centres[cloud, i, 2]
            sx = sy = sz = xx = xy = xz = yy = yz = zz = out.dtype.type(0)
            for t in range(k):
                row = rows[cloud, i, t]
                x, y, z = points[cloud, row, 0], points[cloud, row, 1], points[cloud, row, 2]
                x, y, z = x - cx, y - cy, z - cz
                sx, sy, sz = sx + x, sy + y, sz + z
                xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
                yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
            sums = (sx, sy, sz, xx, xy, xz, xy, yy, yz, xz, yz, zz)
            for place in range(12):
                out[cloud, i, place] = sums[place] / out.dtype.type(k)


@jit_cached
def moments_backward(gradients, points, centres, rows, point_gradients, centre_gradients):
    """Write the gradients of centres from those of ``moments``, and add to those of points.

    Those of the points are left out where their array is empty.
    """
    clouds, m, k = rows.shape
    are_points_fixed = point_gradients.size == 0
    number = points.dtype.type(k)
    for cloud in range(clouds):
        for i in range(m):
            given = gradients[cloud, i]
            gx, gy, gz = given[0] / number, given[1] / number, given[2] / number
            xx, yy, zz = 2 * given[3] / number, 2 * given[7] / number, 2 * given[11] / number
            xy = (given[4] + given[6]) / number
            xz = (given[5] + given[9]) / number
            yz = (given[8] + given[10]) / number
            cx, cy, cz = centres[cloud, i, 0], centres[cloud, i, 1], centres[cloud, i, 2]
            sx = sy = sz = points.dtype.type(0)
            for t in range(k):
                row = rows[cloud, i, t]
                x, y, z = points[cloud, row, 0], points[cloud, row, 1], points[cloud, row, 2]
                x, y, z = x - cx, y - cy, z - cz
                dx = gx + xx * x + xy * y + xz * z
                dy = gy + xy * x + yy * y + yz * z
                dz = gz + xz * x + yz * y + zz * z
                sx, sy, sz = sx + dx, sy + dy, sz + dz
                if are_points_fixed:
                    continue
                point_gradients[cloud, row, 0] += dx
                point_gradients[cloud, row, 1] += dy
                point_gradients[cloud, row, 2] += dz
            centre_gradients[cloud, i, 0] = -sx
            centre_gradients[cloud, i, 1] = -sy
            centre_gradients[cloud, i, 2] = -sz

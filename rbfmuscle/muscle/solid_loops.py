"""Loops over the quadrature points and the contacts of a muscle's elastic solid."""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.rotations import quaternion_matrix, rotation_loop
from rbfmuscle.jit import compiled


class Fibres(NamedTuple):
    """Springs along the fibres at the quadrature points, stiffnesses over twice the shear
    modulus.
    """

    direction: np.ndarray  # (Q, 3) at rest, unit
    passive: np.ndarray  # (Q,) stiffness of a spring that is slack from lower to upper
    active: np.ndarray  # (Q,) stiffness of a spring whose target stretch is ``content``
    lower: np.ndarray  # (Q,) stretch against rest
    upper: np.ndarray  # (Q,)
    content: np.ndarray  # (Q,)


@compiled(error_model="numpy", fastmath={"contract"})
def gradient_rows(y, columns, slopes):
    """Rows of the deformation gradient Σ_k y_k ∇N_k at one point."""
    xx = 0.0
    xy = 0.0
    xz = 0.0
    yx = 0.0
    yy = 0.0
    yz = 0.0
    zx = 0.0
    zy = 0.0
    zz = 0.0
    for k in range(len(columns)):
        j = columns[k]
        u = slopes[k, 0]
        v = slopes[k, 1]
        w = slopes[k, 2]
        x = y[j, 0]
        xx = xx + x * u
        xy = xy + x * v
        xz = xz + x * w
        x = y[j, 1]
        yx = yx + x * u
        yy = yy + x * v
        yz = yz + x * w
        x = y[j, 2]
        zx = zx + x * u
        zy = zy + x * v
        zz = zz + x * w
    return (xx, xy, xz), (yx, yy, yz), (zx, zy, zz)


@compiled(error_model="numpy")
def target_loop(y, columns, slopes, fibre, least, tension, q, t, f, target):
    """Deformation gradients F and their targets R (t aaᵀ + t^(-1/2) (I - aaᵀ)) at all points.

    R is the rotation of F D(t) for the last t, then t minimises |RᵀF - D(t)|² + 2 tension t in
    [least, 1] by Newton's method; over the iterations both converge.
    """
    fd = np.empty((3, 3))
    for i in range(len(columns)):
        first, second, third = gradient_rows(y, columns[i], slopes[i])
        for b in range(3):
            f[i, 0, b] = first[b]
            f[i, 1, b] = second[b]
            f[i, 2, b] = third[b]
        e = fibre[i]
        u = 1.0 / np.sqrt(t[i])
        for a in range(3):
            along = f[i, a, 0] * e[0] + f[i, a, 1] * e[1] + f[i, a, 2] * e[2]
            for b in range(3):
                fd[a, b] = u * f[i, a, b] + (t[i] - u) * along * e[b]
        rotation_loop(fd, q[i])
        r = target[i]
        first, second, third = quaternion_matrix(q[i])
        for b in range(3):
            r[0, b] = first[b]
            r[1, b] = second[b]
            r[2, b] = third[b]
        if least[i] < 1.0:
            # S = RᵀF: s is its part along the fibre, m the sum of those across.
            s, m = 0.0, 0.0
            for a in range(3):
                fa = f[i, a, 0] * e[0] + f[i, a, 1] * e[1] + f[i, a, 2] * e[2]
                ra = r[a, 0] * e[0] + r[a, 1] * e[1] + r[a, 2] * e[2]
                s += ra * fa
                for b in range(3):
                    m += r[a, b] * f[i, a, b]
            m -= s
            v = t[i]
            for _ in range(4):
                v15 = v * np.sqrt(v)
                g = v - 1.0 / (v * v) - s + 0.5 * m / v15 + tension
                h = 1.0 + 2.0 / (v * v * v) - 0.75 * m / (v15 * v)
                v = min(max(v - g / max(h, 0.5), least[i]), 1.0)
            t[i] = v
            u = 1.0 / np.sqrt(v)
            for a in range(3):
                ra = r[a, 0] * e[0] + r[a, 1] * e[1] + r[a, 2] * e[2]
                for b in range(3):
                    r[a, b] = u * r[a, b] + (v - u) * ra * e[b]


@compiled(error_model="numpy")
def stress_loop(f, target, fibres, weights, columns, slopes, region, slot, out, gradient, volume):
    """Right side Σ w T ∇N of the fibres and the rest, volumes of the regions and their gradients.

    ``slot`` (Q, k) says where node k of point q stands in the rows of ``gradient``.
    """
    out[:] = 0.0
    gradient[:] = 0.0
    volume[:] = 0.0
    v, c = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(f)):
        m = f[i]
        c[0, 0] = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
        c[0, 1] = m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]
        c[0, 2] = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
        c[1, 0] = m[0, 2] * m[2, 1] - m[0, 1] * m[2, 2]
        c[1, 1] = m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]
        c[1, 2] = m[0, 1] * m[2, 0] - m[0, 0] * m[2, 1]
        c[2, 0] = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
        c[2, 1] = m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]
        c[2, 2] = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        w = weights[i]
        volume[region[i]] += w * (m[0, 0] * c[0, 0] + m[0, 1] * c[0, 1] + m[0, 2] * c[0, 2])
        for a in range(3):
            for b in range(3):
                v[a, b] = w * target[i, a, b]
                c[a, b] *= w
        stiff = fibres.passive[i] + fibres.active[i]
        if stiff > 0.0:
            fibre, length = fibres.direction[i], 1e-12
            for a in range(3):
                length += (m[a, 0] * fibre[0] + m[a, 1] * fibre[1] + m[a, 2] * fibre[2]) ** 2
            length = np.sqrt(length)
            slack = min(max(length, fibres.lower[i]), fibres.upper[i])
            share = w * (fibres.passive[i] * slack + fibres.active[i] * fibres.content[i]) / length
            for a in range(3):
                along = m[a, 0] * fibre[0] + m[a, 1] * fibre[1] + m[a, 2] * fibre[2]
                for b in range(3):
                    v[a, b] += share * along * fibre[b]
        for k in range(columns.shape[1]):
            j, s = columns[i, k], slot[i, k]
            for a in range(3):
                out[j, a] += (
                    v[a, 0] * slopes[i, k, 0]
                    + v[a, 1] * slopes[i, k, 1]
                    + v[a, 2] * slopes[i, k, 2]
                )
                gradient[s, a] += (
                    c[a, 0] * slopes[i, k, 0]
                    + c[a, 1] * slopes[i, k, 1]
                    + c[a, 2] * slopes[i, k, 2]
                )


@compiled(error_model="numpy")
def press_loop(pressure, start, node, gradient, out):
    """Add the forces Σ_r p_r ∂V_r/∂y of the regions' pressures."""
    for r in range(len(pressure)):
        for s in range(start[r], start[r + 1]):
            for a in range(3):
                out[node[s], a] += pressure[r] * gradient[s, a]


@compiled(error_model="numpy")
def swell_loop(motion, start, node, gradient, out):
    """Volumes Σ ∂V_r/∂y · dy that a motion of the nodes adds to the regions."""
    for r in range(len(out)):
        out[r] = 0.0
        for s in range(start[r], start[r + 1]):
            for a in range(3):
                out[r] += gradient[s, a] * motion[node[s], a]


@compiled(error_model="numpy")
def respond_loop(regions, inverse, yielding, response, factor):
    """Motion of the nodes for a unit of each whitened pressure (M, 3, N); returns whether there is
    one.

    ``factor`` becomes the Cholesky factor (M, M) of the volumes that a unit pressure of each region
    adds to all, and of what each yields.
    """
    start, node, gradient = regions
    count, nodes = len(start) - 1, len(inverse)
    response[:] = 0.0
    for r in range(count):
        for s in range(start[r], start[r + 1]):
            row = inverse[node[s]]
            for a in range(3):
                g = gradient[s, a]
                for n in range(nodes):
                    response[r, a, n] += row[n] * g
    for r in range(count):
        for o in range(r + 1):
            value = 0.0
            for s in range(start[o], start[o + 1]):
                for a in range(3):
                    value += gradient[s, a] * response[r, a, node[s]]
            factor[r, o] = value
        factor[r, r] += 1e-9 * factor[r, r] + yielding[r]
    if not _factor_small(factor):
        return False
    for r in range(count):
        for a in range(3):
            for o in range(r):
                for n in range(nodes):
                    response[r, a, n] -= factor[r, o] * response[o, a, n]
            for n in range(nodes):
                response[r, a, n] /= factor[r, r]
    return True


@compiled(error_model="numpy")
def _factor_small(matrix):
    """Turn the lower triangle of a small matrix into its Cholesky factor; returns whether it is
    positive definite.
    """
    for r in range(len(matrix)):
        for o in range(r + 1):
            for k in range(o):
                matrix[r, o] -= matrix[r, k] * matrix[o, k]
            if o < r:
                matrix[r, o] /= matrix[o, o]
        if not matrix[r, r] > 0.0:
            return False
        matrix[r, r] = np.sqrt(matrix[r, r])
    return True


@compiled(error_model="numpy")
def carry_loop(y, columns, shares, out):
    """Places Σ_k share_k y_k of embedded points."""
    for s in range(len(columns)):
        ax = 0.0
        ay = 0.0
        az = 0.0
        for k in range(columns.shape[1]):
            j, share = columns[s, k], shares[s, k]
            ax += share * y[j, 0]
            ay += share * y[j, 1]
            az += share * y[j, 2]
        out[s, 0] = ax
        out[s, 1] = ay
        out[s, 2] = az


@compiled(error_model="numpy")
def normals_loop(y, columns, slopes, normals, out):
    """Unit normals of the deformed surface: the cofactor of the deformation gradient times those at
    rest.
    """
    f = np.empty((3, 3))
    for s in range(len(normals)):
        f[:] = 0.0
        for k in range(columns.shape[1]):
            j = columns[s, k]
            for a in range(3):
                for b in range(3):
                    f[a, b] += y[j, a] * slopes[s, k, b]
        square = 0.0
        for a in range(3):
            p, q = (a + 1) % 3, (a + 2) % 3
            value = 0.0
            for b in range(3):
                u, v = (b + 1) % 3, (b + 2) % 3
                value += (f[p, u] * f[q, v] - f[p, v] * f[q, u]) * normals[s, b]
            out[s, a] = value
            square += value * value
        for a in range(3):
            out[s, a] /= np.sqrt(square)


@compiled(error_model="numpy")
def _rows_loop(start, index, normal, response, columns, shares, rows):
    """Motion along its normal that each contact from ``start`` on makes for a unit of each whitened
    pressure.
    """
    for c in range(start, len(index)):
        i = index[c]
        for r in range(response.shape[0]):
            value = 0.0
            for k in range(columns.shape[1]):
                j = columns[i, k]
                value += shares[i, k] * (
                    normal[c, 0] * response[r, 0, j]
                    + normal[c, 1] * response[r, 1, j]
                    + normal[c, 2] * response[r, 2, j]
                )
            rows[c, r] = value


@compiled(error_model="numpy")
def _answers_loop(start, index, columns, shares, inverse, answers):
    """Motion of the nodes for a unit force at each contact from ``start`` on: rows of W A⁻¹."""
    for c in range(start, len(index)):
        answers[c] = 0.0
        for k in range(columns.shape[1]):
            share, row = shares[index[c], k], inverse[columns[index[c], k]]
            for j in range(len(row)):
                answers[c, j] += share * row[j]


@compiled(error_model="numpy")
def _pairs_loop(start, index, normal, rows, answers, columns, shares, gram, own):
    """Motion at contact c >= ``start`` for a unit force at contact d, the regions' volumes kept;
    ``own`` for d = c.
    """
    for c in range(start, len(index)):
        for d in range(c + 1):
            value = 0.0
            for k in range(columns.shape[1]):
                value += shares[index[c], k] * answers[d, columns[index[c], k]]
            value *= (
                normal[c, 0] * normal[d, 0]
                + normal[c, 1] * normal[d, 1]
                + normal[c, 2] * normal[d, 2]
            )
            for r in range(rows.shape[1]):
                value -= rows[c, r] * rows[d, r]
            gram[c, d] = value
            gram[d, c] = value
        own[c] = gram[c, c]


@compiled(error_model="numpy")
def mobility_loop(columns, shares, inverse, out):
    """Motion of each embedded point for a unit force at it: w A⁻¹ w."""
    for s in range(len(columns)):
        out[s] = 0.0
        for k in range(columns.shape[1]):
            for m in range(columns.shape[1]):
                out[s] += shares[s, k] * shares[s, m] * inverse[columns[s, k], columns[s, m]]


@compiled(error_model="numpy")
def solve_contact_forces(gram, need, force, sweeps, tolerance, most):
    """Contact forces with 0 <= force <= most and gram · force >= need where force < most.

    By projected Gauss-Seidel from a first guess, in place, until no gap moves by more than the
    tolerance. ``gram`` (c, c) is the motion at contact i for a unit force at contact j, ``need``
    (c,) the motion that each asks for.
    """
    lacking = need.copy()
    for c in range(len(need)):
        if force[c] != 0.0:
            for d in range(len(need)):
                lacking[d] -= gram[c, d] * force[c]
    for _ in range(sweeps):
        largest = 0.0
        for c in range(len(need)):
            change = min(max(0.0, force[c] + lacking[c] / gram[c, c]), most[c]) - force[c]
            if change != 0.0:
                force[c] += change
                largest = max(largest, abs(change) * gram[c, c])
                for d in range(len(need)):
                    lacking[d] -= gram[c, d] * change
        if largest < tolerance:
            break


@compiled(error_model="numpy")
def _deepest(lacking, is_chosen, tolerance, most):
    """Contacts, not yet chosen, that lack the most motion, deepest first; of equals the first."""
    found = np.empty(most, np.int64)
    count = 0
    for c in range(len(lacking)):
        if not lacking[c] > tolerance or is_chosen[c]:
            continue
        if count == most and lacking[c] <= lacking[found[count - 1]]:
            continue
        count = min(count + 1, most)
        place = count - 1
        while place > 0 and lacking[found[place - 1]] < lacking[c]:
            found[place] = found[place - 1]
            place -= 1
        found[place] = c
    return found[:count]


@compiled(error_model="numpy")
def _push_loop(normal, strength, rows, answers, response, push, taken):
    """Motion of the nodes by contact forces, and what these take from the whitened pressures."""
    push[:] = 0.0
    taken[:] = 0.0
    for c in range(len(strength)):
        if strength[c] == 0.0:
            continue
        for j in range(len(push)):
            for a in range(3):
                push[j, a] += answers[c, j] * strength[c] * normal[c, a]
        for r in range(len(taken)):
            taken[r] += strength[c] * rows[c, r]
    for r in range(len(taken)):
        for j in range(len(push)):
            for a in range(3):
                push[j, a] -= taken[r] * response[r, a, j]


@compiled(error_model="numpy")
def _lacking_loop(index, normal, need, columns, shares, push, lacking):
    """Motion that each contact still needs after a push of the nodes."""
    for c in range(len(index)):
        i, value = index[c], need[c]
        for k in range(columns.shape[1]):
            j = columns[i, k]
            value -= shares[i, k] * (
                normal[c, 0] * push[j, 0] + normal[c, 1] * push[j, 1] + normal[c, 2] * push[j, 2]
            )
        lacking[c] = value


@compiled(error_model="numpy")
def contact_loop(
    index,
    gap,
    normal,
    source,
    motion,
    inverse,
    columns,
    shares,
    response,
    table,
    effort,
    law,
    push,
    taken,
):
    """Contact: fill the nodes' ``push`` (N, 3), what it takes from the whitened pressures (M,), and
    the forces.

    The working set starts from the contacts that pushed before and takes in the deepest violations
    until none is left; forces solve the complementarity problem on it.
    """
    batch, rounds, sweeps, tolerance = effort
    yielding, most = law
    count = len(index)
    need, force = np.empty(count), np.empty(count)
    for c in range(count):
        i = index[c]
        need[c] = -gap[c]
        for a in range(3):
            need[c] -= normal[c, a] * motion[i, a]
        force[c] = table[i, source[c]]
    table[:] = 0.0
    push[:] = 0.0
    taken[:] = 0.0
    is_chosen, total = np.zeros(count, np.bool_), 0
    lacking = np.empty(count)
    for c in range(count):
        lacking[c] = need[c]
        if force[c] > 0.0:
            is_chosen[c] = True
            total += 1
    room = min(count, total + rounds * batch)
    # Of the working set the contacts, their points, normals, needs, forces and the greatest of
    # these.
    chosen = np.empty(room, np.int64)
    points = np.empty(room, np.int64)
    ways = np.empty((room, 3))
    wants = np.empty(room)
    strength = np.empty(room)
    limits = np.empty(room)
    rows, answers = np.empty((room, response.shape[0])), np.empty((room, len(push)))
    gram, own = np.empty((room, room)), np.empty(room)
    done, total = 0, 0
    for c in range(count):
        if is_chosen[c]:
            chosen[total] = c
            total += 1
    for _ in range(rounds):
        added = _deepest(lacking, is_chosen, tolerance, batch)
        for c in added:
            is_chosen[c] = True
            chosen[total] = c
            total += 1
        if total == 0:
            break
        for k in range(done, total):
            c = chosen[k]
            points[k] = index[c]
            wants[k] = need[c]
            strength[k] = force[c]
            limits[k] = most[c]
            for a in range(3):
                ways[k, a] = normal[c, a]
        some = points[:total], ways[:total]
        _rows_loop(done, *some, response, columns, shares, rows)
        _answers_loop(done, points[:total], columns, shares, inverse, answers)
        _pairs_loop(done, *some, rows, answers, columns, shares, gram, own)
        done, least = total, 0.0
        for k in range(done):
            least = max(least, 1e-7 * abs(own[k]))
        for k in range(done):
            gram[k, k] = own[k] + least + yielding[chosen[k]]
        solve_contact_forces(gram, wants[:total], strength, sweeps, 0.1 * tolerance, limits)
        _push_loop(ways, strength[:total], rows, answers, response, push, taken)
        if len(added) == 0:
            break
        _lacking_loop(index, normal, need, columns, shares, push, lacking)
    for k in range(total):
        table[points[k], source[chosen[k]]] = strength[k]

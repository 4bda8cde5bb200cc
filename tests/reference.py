"""A NumPy/SciPy finite-element code in Voigt notation: what the JAX code is compared with.

It shares only the tabulated gradients and weights with jaxsmooth (`test_elements` checks those).
"""

import numpy as np
import scipy.sparse as sp

from jaxsmooth.cells.table import element_type


def elasticity_matrix(dim, young=1.0, nu=0.0):
    """D in Voigt notation with engineering shears; plane strain in 2D."""
    lam, mu = young * nu / ((1 + nu) * (1 - 2 * nu)), young / (2 * (1 + nu))
    shears = {2: 1, 3: 3}[dim]
    d = np.zeros((dim + shears, dim + shears))
    d[:dim, :dim] = lam
    d[range(dim), range(dim)] += 2 * mu
    d[range(dim, dim + shears), range(dim, dim + shears)] = mu
    return d


def strain_matrix(gradients):
    """B ``[voigt, k·dim]`` from physical gradients ``[k, dim]``."""
    k, dim = gradients.shape
    pairs = [(0, 1)] if dim == 2 else [(0, 1), (1, 2), (2, 0)]
    b = np.zeros((dim + len(pairs), k, dim))
    for i in range(dim):
        b[i, :, i] = gradients[:, i]
    for row, (i, j) in enumerate(pairs, start=dim):
        b[row, :, i], b[row, :, j] = gradients[:, j], gradients[:, i]
    return b.reshape(len(b), k * dim)


def stiffness(kind, nodes, young=1.0, nu=0.0):
    """K_e = ∫ Bᵀ D B |dV| of one element."""
    row = element_type(kind)
    d = elasticity_matrix(row.dim, young, nu)
    total = 0.0
    for gradients, weight in zip(row.gradients, row.weights, strict=True):
        jacobian = nodes.T @ gradients
        b = strain_matrix(gradients @ np.linalg.inv(jacobian))
        total = total + b.T @ d @ b * (weight * abs(np.linalg.det(jacobian)))
    return total


def assemble(points, blocks, young=1.0, nu=0.0):
    """K of a mesh as a CSR matrix."""
    size = points.size
    total = sp.csr_matrix((size, size))
    for kind, connectivity in blocks.items():
        for element in np.asarray(connectivity):
            unknowns = (element[:, None] * points.shape[1] + np.arange(points.shape[1])).ravel()
            ke = stiffness(kind, points[element], young, nu)
            rows, columns = np.meshgrid(unknowns, unknowns, indexing="ij")
            total = total + sp.csr_matrix((ke.ravel(), (rows.ravel(), columns.ravel())), (size, size))
    return total


def measure(kind, nodes):
    row = element_type(kind)
    return np.linalg.det(np.einsum("kd,qke->qde", nodes, row.gradients)) @ row.weights


def target(kind, nodes, alpha=1.0):
    """Eqs. 22–29 with the determinant correction of Eq. 14, by NumPy's SVD."""
    row = element_type(kind)
    reference = row.ideal * (alpha * abs(measure(kind, nodes)) ** (1 / row.dim))
    a, b = reference - reference.mean(axis=0), nodes - nodes.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    flip = np.ones(row.dim)
    flip[-1] = np.sign(np.linalg.det(vt.T @ u.T))
    r = vt.T @ np.diag(flip) @ u.T
    return a @ r.T + nodes.mean(axis=0)


def forces(points, blocks, weights=None, alpha=1.0, young=1.0, nu=0.0):
    """Eq. 31, or Eqs. 35 and 36 with weights ``{kind: [elements]}``."""
    total = np.zeros_like(points)
    for kind, connectivity in blocks.items():
        for index, element in enumerate(np.asarray(connectivity)):
            nodes = points[element]
            pull = stiffness(kind, nodes, young, nu) @ (target(kind, nodes, alpha) - nodes).ravel()
            factor = 1.0 if weights is None else weights[kind][index]
            np.add.at(total, element, factor * pull.reshape(nodes.shape))
    return total


def lagrange(k, force, normals):
    """Eq. 33: K u + Aᵀ λ = f with A u = 0; `normals` lists independent vectors of every node."""
    dim = force.shape[1]
    rows = [(node, n) for node, vectors in enumerate(normals) for n in vectors]
    a = np.zeros((len(rows), force.size))
    for row, (node, n) in enumerate(rows):
        a[row, node * dim : (node + 1) * dim] = n
    system = np.block([[k.toarray(), a.T], [a, np.zeros((len(rows), len(rows)))]])
    return np.linalg.solve(system, np.r_[force.ravel(), np.zeros(len(rows))])[: force.size].reshape(
        force.shape
    )

"""Spherical harmonics: values against two other formulas, the sign convention, and derivatives."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.special

from mi_refgs.errors import InputError
from mi_refgs.reference import models as reference
from mi_refgs.shade.sh import clamp_positive, eval_sh, sh_basis
from tests.helpers import unit, with_grad


def directions(rng: np.random.Generator, n: int) -> np.ndarray:
    return unit(np.concatenate([rng.normal(size=(n, 3)), np.eye(3), -np.eye(3)]))


def basis_of(d: np.ndarray, degree: int = 3) -> np.ndarray:
    return np.array(sh_basis(mi.Vector3f(d.T.astype(np.float32)), degree)).T


def scipy_basis(d: np.ndarray) -> np.ndarray:
    """Real combinations of SciPy's complex Y_lm, with the Condon-Shortley phase, as 3DGS files have it:
    m < 0: √2 Im Y_l|m|, m = 0: Y_l0, m > 0: √2 Re Y_lm."""
    polar, azimuth = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    out = []
    for n in range(4):
        for m in range(-n, n + 1):
            if hasattr(scipy.special, "sph_harm_y"):
                y = scipy.special.sph_harm_y(n, abs(m), polar, azimuth)
            else:  # SciPy before 1.15
                y = scipy.special.sph_harm(abs(m), n, azimuth, polar)
            out.append(y.real if m == 0 else np.sqrt(2) * (y.imag if m < 0 else y.real))
    return np.stack(out, 1)


def test_against_scipy_and_the_recursion(rng: np.random.Generator) -> None:
    d = directions(rng, 300)
    np.testing.assert_allclose(basis_of(d), scipy_basis(d), atol=2e-6)
    np.testing.assert_allclose(basis_of(d[-56:]), [reference.sh_basis(x, 3) for x in d[-56:]], atol=2e-6)


@pytest.mark.parametrize("degree", range(4))
def test_derivatives_of_eval(degree: int, rng: np.random.Generator) -> None:
    n, count = 40, (degree + 1) ** 2
    d, coefs, weight = directions(rng, n - 6), rng.normal(size=(count, 3, n)), rng.normal(size=(3, n))
    direction = with_grad(mi.Vector3f(d.T.astype(np.float32)))
    colours = with_grad([mi.Color3f(c.astype(np.float32)) for c in coefs])
    dr.backward(dr.dot(mi.Vector3f(eval_sh(colours, direction)), mi.Vector3f(weight.astype(np.float32))))
    basis = np.array([reference.sh_basis(x, degree) for x in d])
    for k in range(count):
        np.testing.assert_allclose(dr.grad(colours[k]).numpy(), basis[:, k] * weight, atol=5e-6)

    # The basis off the unit sphere is only defined up to its formula: compare the tangential derivative.
    def value(x: np.ndarray, i: int) -> float:
        return float(weight[:, i] @ (reference.sh_basis(x / np.linalg.norm(x), degree) @ coefs[:, :, i]))

    got = dr.grad(direction).numpy().T
    for i in range(n):
        tangent = np.cross(d[i], rng.normal(size=3))
        expected = (value(d[i] + 1e-5 * tangent, i) - value(d[i] - 1e-5 * tangent, i)) / 2e-5
        assert abs(got[i] @ tangent - expected) < 2e-4 * (1 + abs(expected))


def test_wrong_numbers_of_coefficients() -> None:
    for count in (0, 2, 25):
        with pytest.raises(InputError, match="coefs"):
            eval_sh([mi.Color3f(1)] * count, mi.Vector3f(0, 0, 1))


def test_clamp_lets_a_coefficient_leave_zero() -> None:
    """Indirect coefficients start at exactly 0; a derivative of 0 there would keep them there for ever."""
    coefs = with_grad([mi.Color3f(dr.zeros(mi.Float, 3)) for _ in range(4)])
    colour = clamp_positive(eval_sh(coefs, mi.Vector3f([1, 0, 0], [0, 0, 1], [0, 1, 0])))
    assert dr.all(colour == 0, axis=None)
    dr.backward(colour)
    assert dr.all(dr.grad(coefs[0]) != 0, axis=None)

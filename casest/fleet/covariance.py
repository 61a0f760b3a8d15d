"""Covariance of many sensors' estimates where noise differs from place to place."""

from __future__ import annotations

import numpy as np

from casest.declaration.model import Model
from casest.declaration.shapes import Array
from casest.estimate.covariance import MANY_RESIDUALS, as_plain
from casest.fleet.derivatives import dense
from casest.fleet.linear import whole
from casest.fleet.local import Local
from casest.fleet.sums import Sensors, Squares
from casest.leastsquares.per_sample import residual_and_jacobian


def sandwich(model: Model, squares: Squares, here: Local, sensors: Sensors) -> Array:
    """Covariance (n, n, W) that holds where noise differs from place to place (HC3)."""
    bread = whole(here.inverse) / (here.scale * here.scale[:, None])
    J = dense(residual_and_jacobian(model), here.fits.x, sensors, 1)
    residual = squares.residuals(here.fits.x, sensors).transpose(1, 2, 0)
    leverage = np.einsum("manw,abw,lbnw->nwml", J, bread, J, optimize=True)
    left = np.eye(len(J)) - np.where(np.isfinite(leverage), leverage, 0.0)
    # A residual that the fit follows entirely says nothing: keep the inverse finite.
    values, vectors = np.linalg.eigh(left)
    inverse = (vectors / np.maximum(values, 1e-3)[..., None, :]) @ vectors.swapaxes(-1, -2)
    unseen = np.einsum("nwml,nwl->mnw", inverse, residual)
    pulls = np.einsum("abw,mbnw,mnw->anw", bread, J, unseen, optimize=True)
    robust = np.einsum("anw,bnw->abw", pulls, pulls)
    own = np.einsum("abw,mbnw->amnw", bread, J) ** 2
    told_by = own.sum(axis=(1, 2)) ** 2 / np.maximum((own**2).sum(axis=(1, 2)), 1e-300)
    plain = here.sigma**2 * np.einsum("aaw->aw", bread)
    return as_plain(robust, plain, told_by < MANY_RESIDUALS)

"""The most likely noise of inputs, along states that the whole record says.

A step x₊ = F(x, u + w) that is linearised about the input as it was read takes w to first order: a
vector that a gyroscope's noise turns grows longer by its square, which matters where readings say
more of w than the gyroscope does. Linearised about the w that states on both sides of the step make
most likely, w̄ = E[w | x₊, x], a round is Gauss's and Newton's step on all states and all noises of
the record at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np

from casest.data.run import Run
from casest.declaration.shapes import Array
from casest.dynamics.declare import Dynamics
from casest.dynamics.discrete import Steps
from casest.dynamics.extended import (
    Sampled,
    at_noise,
    input_names,
    motion,
    shifted,
    two_samples,
    with_errors,
)
from casest.dynamics.inputs import estimates, uncertain
from casest.dynamics.samples import AtSamples

#: Share of what noise makes of a state, and of what it is wrong by, that is taken to be none of the
#: inputs' doing: two states which one noise moves are weighed evenly, and one that it moves by its
#: square alone says nothing of it.
OWN = 1e-3
#: Rounds about the noise found before; standard deviations that noise is not: states that are not
#: near yet say what no noise is.
AGAIN, FAR = 2, 4.0


@dataclass(frozen=True)
class Inputs:
    """Uncertain inputs along smoothed states: their most likely `noise` in each step (N − 1, k),
    what they most likely were (N, …) by name, and covariances of the states on whose `errors`
    noise acts."""

    noise: Array
    calm: Mapping[str, Array]
    errors: Array

    @staticmethod
    def of(
        sampled: Sampled, run: Run, along: Array, errors: Array, before: Inputs | None = None
    ) -> Inputs:
        """Along states (N, n) with covariances `errors` (N, n, n).

        They were as they were read, and that noise; what does not stand out of the noise as it was
        stated is rest. `before`: what they were is kept: next to a limit, what stands out may
        change from round to round.
        """
        noise, model = likely(sampled, along, errors), sampled.model
        if before is not None:
            return replace(before, noise=noise)
        at_samples = np.vstack([noise, noise[-1:]])
        names, sizes = [name for name, _ in _noisy(model)], [size for _, size in _noisy(model)]
        parts = np.split(at_samples, np.cumsum(sizes[:-1]), axis=1)
        each = dict(zip(names, parts, strict=True))
        return Inputs(noise, estimates(model, run, each), errors)

    def steps(self, sampled: Sampled, run: Run, along: Array) -> Steps:
        """The record in discrete time, linearised about them and along states (N, n)."""
        steps = sampled.at(run, self.noise, self.calm).along(along)
        return with_errors(steps, sampled.model, run, along, self.errors)


def likely(sampled: Sampled, states: Array, errors: Array) -> Array:
    """What uncertain inputs were more than they were read in each step, (N − 1, k), for the states
    (N, n), with covariances `errors` (N, n, n), on both sides of it."""
    certain = np.diagonal(errors, axis1=1, axis2=2)[1:]
    given = [states[:-1], states[1:], certain, *sampled.ends, sampled.steps, sampled.shares]
    (found,) = _likely(sampled.model, sampled.parts)([np.ascontiguousarray(x) for x in given])
    return found[:, :, 0]


@lru_cache(maxsize=8)
def _likely(model: Dynamics, count: int) -> AtSamples:
    x, (u, v, h, share) = model.traced.x, two_samples(model)
    after, errors = ca.SX.sym("after", model.size), ca.SX.sym("errors", model.size)
    w = ca.SX.sym("w", len(shifted(model)))
    moves = motion(model, count)
    end = moves(x, *at_noise(model, u, v, w), h, share)[0]
    moved = ca.Function("moved", [x, u, v, h, share, w], [end, ca.jacobian(end, w)], {"cse": True})
    variance = ca.diag(moves(x, u, v, h, share)[2])
    S, found = _intensities(model) * share / h, ca.SX(w.numel(), 1)
    for _ in range(AGAIN):
        end, B = moved(x, u, v, h, share, found)
        by_inputs = (B**2) @ S
        own = ca.fmax(variance - by_inputs, 0) + OWN * (by_inputs + ca.fmax(errors, 0))
        weight = ca.if_else(own > 0, 1 / own, 0)
        information = B.T @ ca.diag(weight) @ B + ca.diag(1 / S)
        found = ca.solve(information, B.T @ (weight * (after - end + B @ found)))
        found = ca.fmin(ca.fmax(found, -FAR * ca.sqrt(S)), FAR * ca.sqrt(S))
    return AtSamples(ca.vertcat(x, after, errors, u, v, h, share), [found])


def _intensities(model: Dynamics) -> ca.DM:
    return ca.DM([model.sensors[name] for name, size in _noisy(model) for _ in range(size)])


def _noisy(model: Dynamics) -> list[tuple[str, int]]:
    """The uncertain inputs that drive the rates, and their sizes, in the order of their noise."""
    noisy, symbols = uncertain(model), model.traced.symbols
    return [(name, symbols[name].numel()) for name in input_names(model) if name in noisy]

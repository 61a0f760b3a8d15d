"""The most likely noise of inputs, along states that the whole record says.

A step x₊ = F(x, u + w) that is linearised about the input as it was read takes w to first order: a
vector that a gyroscope's noise turns grows longer by its square, which matters where readings say
more of w than the gyroscope does. Linearised about the w that states on both sides of the step make
most likely, w̄ = E[w | x₊, x], a round is Gauss's and Newton's step on all states and all noises of
the record at once.
"""

from __future__ import annotations

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

#: Share of a state's noise that is taken to be none of the inputs', so that two states which one
#: noise moves are weighed evenly.
OWN = 1e-3
#: Rounds about the noise found before; standard deviations that noise is not: states that are not
#: near yet say what no noise is.
AGAIN, FAR = 2, 4.0


def about_noise(sampled: Sampled, run: Run, along: Array, errors: Array) -> Steps:
    """The record in discrete time about the most likely noise, along smoothed states (N, n) with
    covariances `errors` (N, n, n).

    Slopes are taken where inputs most likely were: as they were read, and that noise; what does not
    stand out of the noise as it was stated is rest.
    """
    model = sampled.model
    noise = likely(sampled, along)
    at_samples, each, k = np.vstack([noise, noise[-1:]]), dict[str, Array](), 0
    for name in input_names(model):
        if name in uncertain(model):
            size = int(model.traced.symbols[name].numel())
            each[name], k = at_samples[:, k : k + size], k + size
    steps = sampled.at(run, noise, estimates(model, run, each)).along(along)
    return with_errors(steps, model, run, along, errors)


def likely(sampled: Sampled, states: Array) -> Array:
    """What uncertain inputs were more than they were read in each step, (N − 1, k), for the states
    (N, n) on both sides of it."""
    given = [states[:-1], states[1:], *sampled.ends, sampled.steps, sampled.shares]
    (found,) = _likely(sampled.model, sampled.parts)([np.ascontiguousarray(x) for x in given])
    return found[:, :, 0]


@lru_cache(maxsize=8)
def _likely(model: Dynamics, count: int) -> AtSamples:
    x, (u, v, h, share) = model.traced.x, two_samples(model)
    after, w = ca.SX.sym("after", model.size), ca.SX.sym("w", len(shifted(model)))
    moves = motion(model, count)
    end = moves(x, *at_noise(model, u, v, w), h, share)[0]
    moved = ca.Function("moved", [x, u, v, h, share, w], [end, ca.jacobian(end, w)], {"cse": True})
    variance = ca.diag(moves(x, u, v, h, share)[2])
    S, found = _intensities(model) * share / h, ca.SX(w.numel(), 1)
    for _ in range(AGAIN):
        end, B = moved(x, u, v, h, share, found)
        by_inputs = (B**2) @ S
        own = ca.fmax(variance - by_inputs, 0) + OWN * by_inputs
        weight = ca.if_else(own > 0, 1 / own, 0)
        information = B.T @ ca.diag(weight) @ B + ca.diag(1 / S)
        found = ca.solve(information, B.T @ (weight * (after - end + B @ found)))
        found = ca.fmin(ca.fmax(found, -FAR * ca.sqrt(S)), FAR * ca.sqrt(S))
    return AtSamples(ca.vertcat(x, after, u, v, h, share), [found])


def _intensities(model: Dynamics) -> ca.DM:
    noisy = uncertain(model)
    return ca.DM(
        [
            model.sensors[name]
            for name in input_names(model)
            if name in noisy
            for _ in range(model.traced.symbols[name].numel())
        ]
    )

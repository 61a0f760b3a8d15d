"""Models whose cost has many valleys, each with one start that lies in a wrong one."""

from __future__ import annotations

from casest import Residual, atan2, cos, exp, inf, model, param, signal, sin, vertcat


@model
def sine(x=signal(), y=signal(), *, w=param(start=1.0), p=param()):
    return Residual(measured=y, predicted=sin(w * x + p))


@model
def sine_and_level(
    x=signal(), y=signal(), *, size=param(start=1.0), w=param(start=1.0), p=param(), level=param()
):
    return Residual(measured=y, predicted=level + size * sin(w * x + p))


@model
def chirp(x=signal(), y=signal(), *, w=param(start=1.0), a=param(), p=param()):
    return Residual(measured=y, predicted=sin(w * x + a * x**2 + p))


@model
def peak(
    x=signal(),
    y=signal(),
    *,
    level=param(),
    height=param(start=1.0),
    place=param(start=0.0),
    width=param(start=1.0, bounds=(0.0, inf)),
):
    return Residual(measured=y, predicted=level + height * exp(-0.5 * ((x - place) / width) ** 2))


@model
def damped(
    x=signal(),
    y=signal(),
    *,
    size=param(start=1.0),
    decay=param(start=0.1),
    w=param(start=1.0),
    p=param(),
):
    return Residual(measured=y, predicted=size * exp(-decay * x) * sin(w * x + p))


@model
def two_decays(
    x=signal(),
    y=signal(),
    *,
    a=param(start=1.0),
    k=param(start=0.01),
    b=param(start=1.0),
    m=param(start=30.0),
):
    return Residual(measured=y, predicted=a * exp(-k * x) + b * exp(-m * x))


@model
def step(
    x=signal(),
    y=signal(),
    *,
    level=param(),
    height=param(start=1.0),
    place=param(start=-20.0),
    width=param(start=1.0, bounds=(0.0, inf)),
):
    return Residual(measured=y, predicted=level + height / (1 + exp(-(x - place) / width)))


@model
def saturation(x=signal(), y=signal(), *, most=param(start=1.0), half=param(start=1000.0)):
    return Residual(measured=y, predicted=most * x / (half + x))


@model
def encoder(x=signal(), y=signal(2), *, size=param(start=1.0), rate=param(start=1.0), zero=param()):
    angle = rate * x + zero
    return Residual(measured=y, predicted=size * vertcat(cos(angle), sin(angle)))


@model
def wrapped(x=signal(), y=signal(), *, rate=param(start=1.0), zero=param()):
    angle = rate * x + zero
    return Residual(measured=y, predicted=atan2(sin(angle), cos(angle)))

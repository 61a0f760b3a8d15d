"""NIST's 27 certified problems, from both starts: the digits are right, and casest knows it."""

from __future__ import annotations

from functools import cache

import pytest
from nist import MODELS, digits, fewest_digits, read

from casest import attempt

#: Digits that must agree with NIST: of every parameter, its standard deviation, the sum of squares.
VALUES, STD, SQUARES = 6, 4, 6
#: Lanczos1 has exact data: its residual, 1e-13 of readings given to 14 digits, is mostly rounding,
#: so that of its square and of what is derived from it no more than this share is determined.
ROUNDED = 0.05
#: Those that take longest, and those whose model another has: Lanczos3, Gauss2, Chwirut2,
#: Thurber.
DEAR = {
    "Bennett5", "ENSO", "MGH09", "MGH10", "MGH17", "Nelson", "Lanczos1",
    "Lanczos2", "Gauss1", "Gauss3", "Chwirut1", "Rat43", "Hahn1",
}  # fmt: skip


@pytest.fixture(scope="session")
def certified(shared_data):
    return cache(lambda name: read(shared_data, name))


@pytest.mark.parametrize("start", [1, pytest.param(2, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.long] * (n in DEAR)) for n in MODELS]
)
def test_the_certified_values_are_found_from_either_start_alone(name, start, certified):
    nist = certified(name)
    found = attempt(nist.begun_at(nist.starts[start - 1]), [nist.run])
    assert fewest_digits(found.values, nist.values) >= VALUES
    # What NIST certifies takes the noise to be alike everywhere.
    squares, std = 2 * found.problem.cost(found.point), found.plain
    if name == "Lanczos1":
        assert squares == pytest.approx(nist.squares, rel=ROUNDED)
        assert {n: float(s) for n, s in std.items()} == pytest.approx(nist.std, rel=ROUNDED)
    else:
        assert digits(squares, nist.squares) >= SQUARES
        assert fewest_digits(std, nist.std) >= STD
    assert found.certificate.trusted, found.certificate.reasons


@pytest.mark.parametrize("name", MODELS)
def test_the_declared_start_is_nists_first(name, certified):
    declared = {p.name: float(p.start_value()[0]) for p in MODELS[name].parameters}
    assert declared == pytest.approx(certified(name).starts[0], rel=1e-12)


def test_a_start_given_by_the_user_is_believed_only_if_the_declared_one_agrees(certified):
    nist = certified("MGH10")
    found = attempt(MODELS["MGH10"], [nist.run], start=nist.starts[1])
    assert found.certificate.trusted
    assert fewest_digits(found.values, nist.values) >= VALUES


def test_rows_without_a_time_that_are_alike_are_remarked(certified):
    """Kirby2's readings lie on a smooth wave about the fit: as a record in time they would."""
    nist = certified("Kirby2")
    found = attempt(nist.begun_at(nist.starts[1]), [nist.run])
    assert found.correlated_over == 1
    assert any("say so with --rate" in note for note in found.notes)

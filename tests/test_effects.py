"""Every effect of the catalogue: null, attachable, documented, and right about its physics."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import simulators as sim
from scipy.optimize import least_squares
from scipy.signal import lfilter

from casest import effects
from casest.declaration.effect import NOISE
from casest.declaration.symbols import Constant
from casest.effects.placing import placed_in
from casest.errors import CasestError
from casest.results.find import SHIPPED, find_model

T = np.linspace(0, 20, 2001)
#: A smooth motion as a function of time that NumPy and CasADi both evaluate.
SLOW, FAST = 2 * np.pi * 0.5, 2 * np.pi * 1.3


def moving(t, m=np):
    return [8 * m.sin(SLOW * t), 5 * m.cos(FAST * t) + 1, 3 * m.sin(SLOW * t + 1)]


def evaluated(effect, motion, t=T, **numbers):
    """The effect on `motion(t)`, a list of expressions, at times t: (n, len(motion))."""
    time = ca.SX.sym("t")
    value = ca.vertcat(*motion(time))
    given = {k: ca.DM(v) if np.ndim(v) else v for k, v in numbers.items()}
    changed = effect(value, *([time] if effect.extras else []), **given)
    return np.array(ca.Function("f", [time], [changed])(t[None, :])).T


def applied(effect, values, *more, **numbers):
    """The effect on each row of plain values, with further columns."""
    given = {k: ca.DM(v) if np.ndim(v) else v for k, v in numbers.items()}
    rows = zip(values, *more, strict=True)
    return np.array([np.array(ca.DM(effect(*map(ca.DM, row), **given))).ravel() for row in rows])


def states_no_place(effect, model):
    """Does the model lack what the effect acts on? From its declaration alone."""
    if effect.on in ("input", "output", NOISE):
        return False
    return effect.on not in {*model.quantities, *(s.name for s in model.signals)}


def attached(effect, model):
    """The model with the effect at its place, reading a column where it needs one."""
    columns = {s.name: "warmth" for s in effect.extras if s.name == "channel"}
    return model.with_effect(placed_in(effect, model), columns=columns)


# -- all of them -----------------------------------------------------------------------------------

OF_RATES = {e.name for e in effects.CATALOGUE if e.kind == "rate"}
#: Shipped problems of which no two have the same quantities.
APART = {"norm-triangular", "norm-pair", "wheel", "rate-table", "gyro-rests", "steinhart-hart"}
every = pytest.mark.parametrize("effect", effects.CATALOGUE, ids=lambda e: e.name)


def test_names_in_the_catalogue_are_unique():
    names = [e.name for e in effects.CATALOGUE]
    assert len(set(names)) == len(names)


@every
def test_an_effect_says_what_it_is_and_what_would_show_it(effect):
    assert effect.doc.endswith((".", ")"))
    assert effect.formula
    assert effect.shown_by
    unknowns = {n for n, d in effect.declarations if not isinstance(d, Constant)}
    assert {n for n, _ in (*effect.typical, *effect.profile)} <= unknowns


@every
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.long] * (n not in APART)) for n in SHIPPED]
)
def test_an_effect_attaches_where_its_quantity_exists_and_says_so_elsewhere(effect, name):
    """Attaching checks that the effect vanishes at its null value."""
    model = find_model(name)
    try:
        extended, why = attached(effect, model), ""
    except CasestError as error:
        extended, why = None, str(error)
    if extended is None:
        words = ("not applicable", "declares no corrected quantity", "names no prediction")
        assert any(word in why for word in words), why
        of_other_models = effect.name in ("table_angle", "signal_lag") or effect.kind == "rate"
        assert name != "wheel" or of_other_models
    else:
        assert not states_no_place(effect, model)
        assert len(extended.effects) == len(model.effects) + 1


# -- physics, against what was not written from the effect's formula -------------------------------


def test_imbalance_is_what_an_eccentric_mass_does_to_a_wheel():
    """Mean phase and rate are fitted to the integrated motion; the rest is the effect's."""
    angle, _, _ = sim.physical_motion(T, 0.4, 9.0, drag=0, friction=0, eccentric=0.3)

    def missed(x, kappa=0.3):
        motion = lambda t: [x[0] + x[1] * t]  # noqa: E731
        return evaluated(effects.imbalance, motion, sine=kappa, cosine=0.0)[:, 0] - angle

    found = least_squares(missed, [0.4, 9.0], x_scale=[1, 0.1])
    assert np.abs(found.fun).max() < 1e-6
    assert np.abs(missed(found.x, 0.0)).max() > 3e-3


def test_axis_delay_is_a_later_look_at_each_axis():
    delay = np.array([2e-3, -1e-3, 3e-3])
    late = np.column_stack([moving(T - d)[k] for k, d in enumerate(delay)])
    assert (
        np.abs(evaluated(effects.axis_delay, lambda t: moving(t, ca), delay=delay) - late).max()
        < 1e-5
    )


def test_time_delay_is_a_later_look_at_everything():
    np.testing.assert_allclose(applied(effects.time_delay, T, delay=0.005)[:, 0], T - 0.005)


def test_low_pass_is_a_first_order_filter_run_on_a_finer_grid():
    step, tau = 1e-5, 5e-3
    fine = np.arange(0, 3, step)
    keep = np.arange(100_000, len(fine), 1000)  # once the filter has settled
    a = np.exp(-step / tau)
    true = lfilter([1 - a], [1, -a], np.array(moving(fine)), axis=1).T[keep]
    found = evaluated(effects.low_pass, lambda t: moving(t, ca), fine[keep] + step / 2, tau=tau)
    assert np.abs(found - true).max() < 2e-3
    plain = np.array(moving(fine[keep])).T
    assert np.abs(plain - true).max() > 0.1


def test_saturation_is_clipping():
    y = np.array(moving(T[::20])).T
    cut = applied(effects.saturation, y, share=np.ones(3), level=4.0)
    np.testing.assert_allclose(cut, np.clip(y, -4, 4), atol=1e-14)


def test_dead_zone_is_what_friction_takes_from_either_side():
    y = np.array(moving(T[::20])).T
    width = np.array([0.5, 1.0, 0.0])
    found = applied(effects.dead_zone, y, width=width)
    np.testing.assert_allclose(found, y - np.clip(y, -width, width), atol=1e-14)


def test_lever_arm_adds_the_acceleration_of_a_place_further_out():
    """Centripetal, of a point on a circle: positions differentiated twice."""
    arm, step = np.array([0.3, -0.1, 0.2]), 1e-4
    angle = lambda t: 9 * t - 0.05 * t**2  # noqa: E731
    moments = np.array([-step, 0, step]) + T[:50, None]
    x, y = np.cos(angle(moments)), np.sin(angle(moments))
    inwards = [np.diff(c, 2, axis=1)[:, 0] / step**2 for c in (x, y)]
    radial = -(inwards[0] * x[:, 1] + inwards[1] * y[:, 1])
    time = ca.SX.sym("t")
    changed = effects.lever_arm(ca.SX.zeros(3), angle(time), time, arm=ca.DM(arm))
    found = np.array(ca.Function("f", [time], [changed])(T[None, :50])).T
    np.testing.assert_allclose(found, np.outer(radial, arm), atol=1e-5)


def test_the_speed_polynomial_holds_what_a_cubic_speed_leaves_of_a_wheel_slowed_by_drag():
    t = np.linspace(0, 60, 601)
    angle, _, _ = sim.physical_motion(t, 0.0, 9.0, drag=2e-3)
    x = 2 * t / 60 - 1
    declared = np.polynomial.legendre.legvander(x, 4)
    zero = lambda s: [0 * s]  # noqa: E731
    more = [evaluated(effects.speed_polynomial, zero, t, c=row, duration=60.0) for row in np.eye(4)]
    left = []
    for basis in (declared, np.hstack([declared, *more])):
        c = np.linalg.lstsq(basis, angle, rcond=None)[0]
        left.append(np.abs(angle - basis @ c).max())
    assert left[1] < left[0] / 50


def test_cross_axis_is_a_sensor_whose_axes_are_skewed():
    """Each axis reads the projection onto its own direction; x is kept, to first order in skew."""
    force, k = np.array(moving(T[::20])).T, np.array([1e-3, -2e-3, 1.5e-3])
    axes = np.array([[1, 0, 0], [k[0], 1, 0], [k[1], k[2], 1]])
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    found = applied(effects.cross_axis, force, k=k)
    assert np.abs(found - force @ axes.T).max() < 8e-5


def test_drift_and_step_are_what_is_recorded_when_an_offset_moves():
    y, t, k = np.array(moving(T[::20])).T, T[::20], np.array([0.1, -0.2, 0.3])
    drifted = y + np.array([k * when for when in t])
    np.testing.assert_allclose(applied(effects.bias_drift, y, t, k=k), drifted)
    knocked = y.copy()
    knocked[np.searchsorted(t, 7.1) :] += k
    np.testing.assert_allclose(applied(effects.bias_step, y, t, k=k, when=7.1), knocked)


def test_temperature_moves_offset_and_gain_about_its_mean():
    y, k = np.array(moving(T[::20])).T, np.array([0.01, -0.02, 0.03])
    warm = 20 + 5 * np.tanh(T[::20])
    for bias, gain in (
        (effects.temperature_bias, effects.temperature_gain),
        (effects.channel_bias, effects.channel_gain),
    ):
        moved = applied(bias, y, warm, k=k, at=20.0) - y
        np.testing.assert_allclose(moved[:, 0] / k[0], warm - 20, atol=1e-10)
        stretched = applied(gain, y, warm, k=k, at=20.0)
        np.testing.assert_allclose(stretched, y @ np.diag(1 - 20 * k) + y * np.outer(warm, k))


def test_table_angle_stays_a_rotation_and_moves_the_yaw_by_a_first_harmonic():
    from scipy.spatial.transform import Rotation

    yaw = np.linspace(-3, 3, 13)
    for psi in yaw:
        attitude = Rotation.from_euler("ZYX", [psi, 0.3, -0.8])
        turned = np.array(
            ca.DM(effects.table_angle(ca.DM(attitude.as_matrix()), cosine=1e-3, sine=2e-3))
        )
        moved = Rotation.from_matrix(turned).as_euler("ZYX") - [psi, 0.3, -0.8]
        expected = 1e-3 * np.cos(psi) + 2e-3 * np.sin(psi)
        np.testing.assert_allclose(moved, [expected, 0, 0], atol=1e-12)


def test_hysteresis_lags_behind_whichever_way_the_reading_moves():
    y = np.array(moving(T)).T
    ahead, behind = np.array(moving(T + 0.05)).T - y, y - np.array(moving(T - 0.05)).T
    found = evaluated(effects.hysteresis, lambda t: moving(t, ca), k=np.full(3, 0.02))
    clear = np.sign(ahead) == np.sign(behind)  # it does not turn round within fifty milliseconds
    assert clear.mean() > 0.8
    away = (y - found) / 0.02 - np.sign(ahead)
    assert np.mean(np.abs(away[clear])) < 1e-3
    assert np.median(np.abs(away[clear])) < 1e-5
    assert np.abs(y - found).max() < 0.02 * (1 + 1e-9)


def test_a_shipped_effect_goes_by_its_name_where_the_model_has_its_quantity():
    from casest.cli.loading import declared_model
    from casest.cli.options import ModelOptions

    model = declared_model("norm-diagonal", ModelOptions(effects=("quadratic",)))
    (added,) = model.effects
    assert added.effect.on == find_model("norm-diagonal").traced.corrected
    assert model.parameters[-1].name == "quadratic.k"

"""The measured records, how each is closed, what it can support, and what is right to say of it.

What a record supports was computed with NumPy and SciPy alone, not with casest: F tests and
held-out stretches of linear and of least-squares fits, lags by interpolating one series at shifted
times, each written into its row.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from record_files import AT_REST, ROOT

MODELS = str(ROOT / "studies" / "record_models.py")

#: Kinds of names that say the same of a record.
LAG = frozenset({"time_delay", "signal_lag", "axis_delay"})
SKEW = frozenset({"cross_axis", "soft_iron", "gain_matrix"})
IRON = SKEW | {"axis_gain", "table_angle"}
MEMORY = frozenset({"low_pass", "creep", "hysteresis"}) | LAG
SLOW = frozenset({"bias_drift", "bias_course", "bias_ramp", "warm_up", "bias_step", "pulse"})
BY_TEMPERATURE = frozenset({"temperature_bias", "temperature_curve"})
BY_COLUMN = frozenset({"channel_bias", "channel_curve"})
#: Even in the reading: not to be told apart at readings of one length.
EVEN = frozenset({"quadratic", "signed_cubic", "gain_by_sign", "cross_quadratic"})
#: Of the noise, not of the sensor: in nobody's way.
OF_NOISE = frozenset({"outliers", "bias_wander"})

ANY = ("adequate", "extended", "unexplained")
FOUND = ("extended", "unexplained")


@dataclass(frozen=True)
class Right:
    """What may be said of a record, and what must.

    verdicts: those that are right. named: of each group one name must be claimed. may: what may be
    claimed beside these; anything else is wrong. rivals: these names explain the record alike, so
    that one of them alone, without another beside it, is wrong. within: the error on stretches held
    out whole must be below, in the unit of the reading. values: parameter -> its size lies between.
    """

    verdicts: tuple[str | None, ...]
    named: tuple[frozenset[str], ...] = ()
    may: frozenset[str] = frozenset()
    rivals: frozenset[str] = frozenset()
    within: float | None = None
    values: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Record:
    """One record: how it is closed, what it can support, what is right.

    reading: keywords of `load_runs`, which are the command line's options too.
    """

    name: str
    model: str
    file: str
    supports: str
    right: Right
    reading: Mapping[str, Any] = field(default_factory=dict)
    options: tuple[str, ...] = ()

    @property
    def words(self) -> list[str]:
        """The command line but for the files' places."""
        return ["close", self.model, self.file, *_options(self.reading), *self.options]


def _options(reading: Mapping[str, Any]) -> Iterator[str]:
    for name, columns in reading.get("columns", {}).items():
        yield from ("--columns", f"{name}={','.join(map(str, columns))}")
    for option, key in (("--unit", "units"), ("--scale", "scales")):
        for name, text in reading.get(key, {}).items():
            yield from (option, f"{name}={text}")
    if "rate" in reading:
        yield from ("--rate", f"{reading['rate']:g}")
    if reading.get("at_rest"):
        yield "--at-rest"


def _mpu9150(unit: str, supports: str, within: float) -> Record:
    return Record(
        f"MPU-9150 {unit}, rest positions",
        "norm-diagonal",
        f"mpu9150-mikoff/{unit}.log",
        supports,
        Right(FOUND, (SKEW,), within=within),
        {"columns": {"v": (0, 1, 2)}, "units": {"v": "m/s^2"}, "rate": 100.0, "at_rest": True},
        ("--set", "norm=9.80665"),
    )


def _xsens(name: str, *options: str) -> Record:
    return Record(
        f"Xsens, rest positions{name}",
        "norm-diagonal",
        "xsens-imutk/xsens_acc.mat",
        "Skew of the axes: nine unknowns against six F(3, 29) = 11 100; each position left out, "
        "16.1 → 0.60 counts.",
        Right(FOUND, (SKEW,), within=1.0),
        {"columns": {"t": (0,), "v": (1, 2, 3)}, "units": {"v": "count"}, "at_rest": True},
        ("--set", "norm=9.81744 m/s^2", *options),
    )


def _qmc(which: str, supports: str) -> Record:
    return Record(
        f"QMC5883L, turned by hand, {which}",
        "norm-triangular",
        f"qmc5883l-tomisuarez/{which}_raw_data.csv",
        supports,
        Right(("unexplained",)),
        {"columns": {"v": ("mx", "my", "mz")}, "units": {"v": "count"}, "rate": 50.0},
        ("--set", "norm=1"),
    )


def _headings(which: str, supports: str, right: Right) -> Record:
    return Record(
        f"Ren & Liu, Table IV: nine headings {which} calibration",
        "compass.py",
        f"{which}.csv",
        supports,
        right,
        options=("--effects", "compass.py"),
    )


def _log171(which: str, supports: str, within: float) -> Record:
    alike = BY_COLUMN | {"bias_step", "pulse", "channel_gain", "channel_gain_curve"}
    return Record(
        f"ArduPilot log 171, {which}, until it falls",
        f"{MODELS}:compass",
        f"{which}_flight.csv",
        supports,
        Right(
            ("unexplained",),
            (alike, LAG),
            may=IRON,
            rivals=alike,
            within=within,
            values={"delay": (0.03, 0.08), "lag": (0.03, 0.08)},
        ),
    )


def _broad(which: str, supports: str, right: Right) -> Record:
    return Record(f"BROAD {which}", f"{MODELS}:compass", f"broad/{which}.csv", supports, right)


def _cell(which: str, supports: str) -> Record:
    return Record(
        f"Swing, load cell {which.upper()}",
        f"{MODELS}:cell",
        "swing-project/loadcell_swing.csv",
        supports,
        Right(("adequate", "unexplained"), within=90.0),
        {
            "columns": {"load": ("load_lb",), "counts": (f"cell{which.upper()}_counts",)},
            "units": {"load": "lbf", "counts": "count"},
        },
    )


def _throttle(model: str, supports: str, right: Right) -> Record:
    return Record(
        f"Fixed wing, magnetometer with throttle, {model}",
        model,
        "mag-throttle/mag_throttle.csv",
        supports,
        right,
        {
            "columns": {"t": ("t_s",), "v": ("mag_x_mGauss", "mag_y_mGauss", "mag_z_mGauss")},
            "units": {"v": "mgauss"},
        },
        ("--set", "norm=491 mgauss"),
    )


def _mpu6050(which: str, letter: str, supports: str, right: Right) -> Record:
    return Record(
        f"MPU-6050 at rest, {which}",
        "at_rest_counts.py",
        "mpu6050-tomisuarez/imu_static_test.csv",
        supports,
        right,
        {
            "columns": {"v": tuple(f"{letter}{axis}" for axis in "xyz")},
            "units": {"v": "count"},
            "rate": 100.0,
        },
    )


TWIST = (
    "A lag of 0.3266 s (quarters 0.3266, 0.3266, 0.3258, 0.3260; published 0.32668), 0.0025 rad/s "
    "left; axes turned by 179 degrees about z. No drift of the clocks can be seen in 9.8 s."
)
SWING = "A lag of 3.59 s (by acceleration 3.575; published by eye 3.565): 0.785 → 0.069 rad/s."


def _together(
    name: str, file: str, supports: str, lag: tuple[float, float], within: float
) -> Record:
    """Two gyros on one body, each with a clock and axes of its own."""
    return Record(
        f"Two gyros, {name}",
        f"{MODELS}:two_gyros",
        file,
        supports,
        Right(FOUND, (LAG,), may=IRON | MEMORY, within=within, values={"delay": lag, "lag": lag}),
    )


RECORDS = (
    _xsens(""),
    _xsens(", skew asked for", "--effects", "cross_axis"),
    _mpu9150("imu0", "Skew: F = 761; a position left out, 0.0221 → 0.0021 m/s^2.", 0.0036),
    _mpu9150("imu1", "Skew: F = 399; a position left out, 0.0184 → 0.0024 m/s^2.", 0.0042),
    _mpu9150("imu2", "Skew: F = 622; a position left out, 0.0221 → 0.0024 m/s^2.", 0.0042),
    _mpu9150(
        "imu3",
        "Skew, the smallest of the five: F = 28, p = 6e-6 on 22 positions; 0.0062 → 0.0029 m/s^2.",
        0.0045,
    ),
    _mpu9150("imu4", "Skew: F = 55, p = 1e-7; a position left out, 0.0116 → 0.0041 m/s^2.", 0.0065),
    Record(
        "Ferraris session, six positions (NilsPod)",
        "norm-diagonal",
        "imucal/example_ferraris_session.csv",
        "Nothing with a name: six unknowns from six positions. Rests of one position differ by up "
        "to ten of their standard errors, so a misfit there is.",
        Right((None, "unexplained")),
        {
            "columns": {"v": ("acc_x", "acc_y", "acc_z")},
            "units": {"v": "m/s^2"},
            "rate": 102.4,
            "at_rest": True,
        },
        ("--set", "norm=9.80665"),
    ),
    Record(
        "psim, gyro at rest in a cold test (TVC)",
        str(AT_REST),
        "psim-thermal/TVCtest3_7_20.csv",
        "A line over temperature or over time, correlated by -0.9993: bursts held out, three "
        "spikes left away, 1.88e-3 → 5.57e-4 or 5.61e-4 rad/s, bent 5.53e-4 or 5.56e-4. x and y "
        "change, z does not; the cause is open.",
        Right(
            FOUND,
            (BY_TEMPERATURE | SLOW,),
            rivals=BY_TEMPERATURE | SLOW | {"vibration"},
            within=7.5e-4,
        ),
        {
            "columns": {"v": ("gyrox", "gyroy", "gyroz")},
            "units": {"v": "rad/s", "temp": "degC"},
            "scales": {"temp": "int16/256+25"},
        },
    ),
    _mpu6050(
        "gyro",
        "g",
        "A line at 38.67 Hz on y, power 33 where noise alone has 8.5 at most: 0.7 % of that axis's "
        "variance; on z a slow 0.4 %.",
        Right(ANY, may=frozenset({"vibration"}), within=12.6),
    ),
    _mpu6050(
        "accelerometer",
        "a",
        "Nothing but white noise: highest line 9.2 where 8.5 is expected of 5000, no slow part.",
        Right(("adequate",), within=62.0),
    ),
    _qmc(
        "noisy",
        "A misfit of 6 % of the radius, 59 counts on stretches held out, of no cause that a sensor "
        "has: the field was not the same everywhere, or the hand's iron moved.",
    ),
    _qmc(
        "filtered",
        "A misfit of 3 % of the radius, 29 counts on stretches held out, alike over 200 samples "
        "(15 % of it in 60 block means).",
    ),
    _headings(
        "before",
        "The first harmonic, the user's own effect, halves the error: F(2, 6) = 13.5, p = 0.006. "
        "Nine readings say that much of an effect that is asked for, and no more.",
        Right(FOUND, (frozenset({"deviation"}),)),
    ),
    _headings(
        "after",
        "Nothing beyond the readings' own repeatability, 0.57 degrees.",
        Right(("adequate",)),
    ),
    _log171(
        "MAG",
        "Stretches held out: 20.3 mG; current 13.4, a step at take-off 12.8, the two 12.7; a lag "
        "of 53 ms besides 11.7 and 10.9. In the air alone current does nothing (13.20 → 13.16), "
        "the lag does (10.15). At rest it scatters by 1 mG: more is missing.",
        12.5,
    ),
    _log171(
        "MAG2",
        "Stretches held out: 30.3 mG; current 17.2, step 16.9, both 16.5; with a lag of 54 ms "
        "16.1, 15.7, 15.3; in the air current 18.5 → 17.9, lag 16.5.",
        17.0,
    ),
    _log171(
        "MAG3",
        "Stretches held out: 47.8 mG; current 25.6, step 25.6, both 24.8; with a lag of 50 ms "
        "24.8, 24.6, 23.9, with all of a 3x3 too 19.8.",
        26.0,
    ),
    _broad(
        "mag26",
        "A lag of 15.6 ms (1.366 → 1.013 uT on stretches held out) and a 3x3 (0.849); the 3x3 "
        "alone 1.258. An offset while it is moved, 38.1 to 148.4 s, besides: 0.813; gains by a "
        "gyro's or an accelerometer's axis 0.3 % at most.",
        Right(
            FOUND,
            (LAG, IRON),
            may=frozenset({"pulse"}),
            within=0.95,
            values={"delay": (0.012, 0.019), "lag": (0.012, 0.019)},
        ),
    ),
    _broad(
        "mag01",
        "A 3x3 (1.273 → 1.131 uT on stretches held out), a lag of 11 ms (1.236), both 1.108. An "
        "offset while it is moved, 34.6 to 156.5 s, besides: 0.744 (at 39 to 161 s 0.873); "
        "following the vertical in the body, or acceleration, 0.92, 0.94; beside the offset an "
        "even term gives 0.6 %, a gain by acceleration 0.2 %. The place perhaps: it lies still "
        "before and after.",
        Right(("unexplained",), (IRON,), may=LAG | BY_COLUMN | {"pulse"}, within=1.2),
    ),
    _broad(
        "mag32s",
        "A magnet on the body from 38.3 to 95.3 s, (-7, -2, 58) uT: 17.6 → 2.05 uT on stretches "
        "held out, with a lag of 17 ms 1.96; the best single step 12.0. Without its coming and "
        "going 0.769, a 3x3 0.732, another offset afterwards and a field that falls by 0.015 % a "
        "second besides 0.714.",
        Right(
            FOUND,
            (frozenset({"pulse"}),),
            may=LAG | IRON | {"bias_step", "reference_drift"},
            within=2.5,
        ),
    ),
    _cell(
        "a",
        "A straight line, 997.2 counts/lbf; 14 plateaus: hysteresis F = 0.004, quadratic 0.10, "
        "drift 0.0001. The plateaus' means scatter by 26 counts where 10 are expected: each "
        "weight's own error.",
    ),
    _cell(
        "b",
        "A straight line, 1004.2 counts/lbf; three samples at -8.38e6. 14 plateaus: quadratic "
        "F = 0.07; hysteresis p = 0.035 and drift p = 0.06, not told apart, one plateau of one "
        "sample decides.",
    ),
    _throttle(
        "norm-triangular",
        "Stretches held out: 6.93 mG, a line over throttle 6.61, its square too 6.71; "
        "(-4, -14, 7) mG at full throttle.",
        Right(FOUND, (BY_COLUMN,), may=SKEW, within=6.85),
    ),
    _throttle(
        "norm-diagonal",
        "Stretches held out: 7.99 mG, skew 6.93, a line over throttle 7.13, both 6.61, its square "
        "too 6.71.",
        Right(FOUND, (SKEW,), may=BY_COLUMN, within=7.1),
    ),
    Record(
        "MPU-9250 waved about, magnetometer",
        "norm-diagonal",
        "ckexplorer/acc_mag_log.csv",
        "Skew: 0.0074 → 0.0042 gauss on stretches held out, of 0.30. What is left is alike over 50 "
        "samples, a third of it in 60 block means: of unknown cause.",
        Right(("unexplained",), (SKEW,), within=0.0048),
        {"columns": {"v": ("mx", "my", "mz")}, "units": {"v": "gauss"}, "rate": 100.0},
        ("--set", "norm=0.3"),
    ),
    Record(
        "MPU-9250 waved about, accelerometer",
        "norm-diagonal",
        "ckexplorer/acc_log.csv",
        "Little: stretches held out 4.010e-3 g, skew 3.965e-3, a term even in the reading 3.886e-3 "
        "(quadratic, a cubic's size and a gain by sign alike, at one length), a cubic 3.994e-3.",
        Right(FOUND, may=SKEW, rivals=EVEN, within=4.0e-3),
        {"columns": {"v": ("ax", "ay", "az")}, "units": {"v": "g"}, "rate": 100.0},
        ("--set", "norm=1"),
    ),
    Record(
        "MPU-6050 turned by 90 degrees, angle integrated",
        f"{MODELS}:steady",
        "turned.csv",
        "Gravity over the angle, once per turn: y 3.64 → 0.039, z 4.14 → 0.096 m/s^2, x 0.145 → "
        "0.073; held out 3.53 → 0.077, a line 0.30, a quadratic 0.10, a cubic 0.18, a step 0.58. "
        "A quarter of a turn shows no second harmonic.",
        Right(FOUND, (frozenset({"harmonic"}),), within=0.0095),
    ),
    Record(
        "A thermometer in a cold chamber, both recorded (ETU)",
        f"{MODELS}:thermometer",
        "cold.csv",
        "A first-order lag of 83 min behind the chamber, which falls by 64 K: 2.72 → 0.154 K; "
        "F(2, 30) = 4670 on 34 readings, rounded to 0.1 K.",
        Right(FOUND, (MEMORY,), within=0.6),
    ),
    Record(
        "A house, its weather and sun",
        f"{MODELS}:house",
        "house.csv",
        "Little: 1.94 K of scatter, 1.91 on stretches held out; neighbours alike (0.97). It is not "
        "known what was heated. A parabola over the supply's temperature 1.77, and nine of ten "
        "stretches better (t = 4.9).",
        Right(("unexplained",), may=MEMORY | BY_COLUMN | BY_TEMPERATURE, within=2.2),
    ),
    _together("twistnsync", "twist.csv", TWIST, (0.325, 0.328), 0.006),
    _together("one swing", "swing.csv", SWING, (3.56, 3.62), 0.13),
    _together("twistnsync, two files", "mcu_w.csv+phone_u.csv", TWIST, (0.325, 0.328), 0.006),
    _together("one swing, two files", "bno_w.csv+iphone_u.csv", SWING, (3.56, 3.62), 0.13),
)

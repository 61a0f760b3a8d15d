"""ROS bags and PX4 logs as data files: topics, times, units, several topics, damage."""

from __future__ import annotations

import csv
import json
import subprocess
import sys

import logs
import numpy as np
import pytest
import simulators as sim
from pymavlink import DFReader

from casest.cli import run
from casest.data import read_table
from casest.errors import DataError, UsageError

V = "v=linear_acceleration"
G = ("--set", "norm=9.80665 m/s^2")


@pytest.fixture(scope="module")
def sensor():
    return sim.accelerometer(np.random.default_rng(1))


@pytest.fixture(scope="module")
def readings(sensor):
    rng = np.random.default_rng(2)
    return sensor.read(sim.spread_poses(60, rng), 5e-3, rng)


def error_of(path) -> str:
    with pytest.raises((DataError, UsageError)) as caught:
        read_table(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def assert_found(result, sensor):
    """The truth lies within five of the printed standard deviations, and these are small."""
    found = result["estimate"]["parameters"]
    for name, true in (("scale", np.tril(sensor.scale)), ("offset", sensor.b)):
        value, std = (np.array(found[name][what]) for what in ("value", "std"))
        assert std.max() < 5e-3
        assert np.abs(value - true).max() < 5 * std.max()


# -- ROS bags --------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", logs.FORMATS)
def test_a_topic_of_a_bag_is_calibrated(form, sensor, readings, tmp_path):
    make = logs.Messages(form)
    path = logs.bag(
        tmp_path / ("flight.bag" if form == "bag" else "flight"),
        form,
        {
            "/imu/data": logs.imu_topic(form, readings),
            "/chatter": ("std_msgs/msg/String", [(logs.BEGIN, make.text("hello"))]),
        },
    )
    data = f"{path}:/imu/data"
    out = tmp_path / "out"
    assert run(["calibrate", "norm-triangular", data, "--columns", V, *G, "-o", str(out)]) == 0
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert_found(result, sensor)
    assert result["data"] == [data]
    assert result["runs"] == ["flight"]
    assert len(result["reproduce"]["sha256"][data]) == 64
    report = (out / "report.html").read_text(encoding="utf-8")
    assert ("flight.bag:/imu/data" if form == "bag" else "flight:/imu/data") in report


def test_the_data_file_of_a_ros_2_bag_is_read_without_its_folder(readings, tmp_path):
    for form, suffix in (("sqlite3", "db3"), ("mcap", "mcap")):
        folder = logs.bag(tmp_path / form, form, {"/imu": logs.imu_topic(form, readings)})
        table = read_table(folder / f"{form}.{suffix}")
        np.testing.assert_array_equal(table.columns["linear_acceleration.y"].values, readings[:, 1])


def test_columns_have_the_units_of_rep_103_and_seconds_from_the_first_sample(readings, tmp_path):
    table = read_table(logs.bag(tmp_path / "a.bag", "bag", {"/i": logs.imu_topic("bag", readings)}))
    units = {name: column.unit for name, column in table.columns.items()}
    assert units == {
        "t": "s",
        **{f"angular_velocity.{axis}": "rad/s" for axis in "xyz"},
        **{f"linear_acceleration.{axis}": "m/s^2" for axis in "xyz"},
    }
    # Absolute seconds would be rounded to 2.4e-7 s; the stamps count, not the 2 ms later arrival.
    np.testing.assert_allclose(table.columns["t"].values, np.arange(60) * 0.01, rtol=0, atol=1e-12)
    assert "time of /i: header stamps" in table.notes
    assert any("orientation left out" in note for note in table.notes)


def test_an_orientation_that_is_measured_is_read(tmp_path):
    make = logs.Messages()
    half = np.sqrt(0.5)
    messages = [
        (
            logs.BEGIN + i,
            make.imu(logs.BEGIN + i, (0, 0, 9.8), attitude=(half, 0, 0, half), known=True),
        )
        for i in range(3)
    ]
    table = read_table(
        logs.bag(tmp_path / "a.bag", "bag", {"/i": ("sensor_msgs/msg/Imu", messages)})
    )
    assert [table.columns[f"orientation.{p}"].values[0] for p in "xyzw"] == [half, 0, 0, half]


def test_without_stamps_the_times_of_recording_are_used_and_it_is_said(tmp_path):
    make = logs.Messages()
    messages = [(logs.BEGIN + 10**8 * i, make.imu(0, (i, 0, 9.8))) for i in range(5)]
    table = read_table(
        logs.bag(tmp_path / "a.bag", "bag", {"/i": ("sensor_msgs/msg/Imu", messages)})
    )
    np.testing.assert_allclose(table.columns["t"].values, np.arange(5) * 0.1, atol=1e-12)
    assert "time of /i: when each message was recorded (all header stamps are 0)" in table.notes


def test_a_field_in_tesla_is_no_acceleration(tmp_path, capsys):
    make = logs.Messages()
    messages = [
        (logs.BEGIN + 10**7 * i, make.field(logs.BEGIN + 10**7 * i, (1e-5 * i, 2e-5, 4e-5)))
        for i in range(30)
    ]
    path = logs.bag(tmp_path / "a.bag", "bag", {"/m": ("sensor_msgs/msg/MagneticField", messages)})
    assert run(["calibrate", "wheel", str(path), "--columns", "v=magnetic_field"]) == 1
    said = capsys.readouterr().err
    assert "column magnetic_field.x is in T and signal v wants m/s^2" in said


def test_a_missing_signal_names_the_fields_and_suggests_those_of_its_unit(
    readings, tmp_path, capsys
):
    path = logs.bag(tmp_path / "a.bag", "bag", {"/i": logs.imu_topic("bag", readings)})
    assert run(["calibrate", "wheel", str(path)]) == 1
    said = capsys.readouterr().err
    assert "the file has t, angular_velocity.x" in said
    assert (
        "try --columns v=linear_acceleration.x,linear_acceleration.y,linear_acceleration.z" in said
    )


@pytest.fixture
def two_topics(tmp_path):
    """Force at 200 Hz and flux at 50 Hz, 1.3 ms later, all linear in time; a hole in the force."""
    make = logs.Messages()
    imu, field = [], []
    for i in range(400):
        stamp = logs.BEGIN + i * 5_000_000
        if not 200 <= i < 240:
            force = np.array([0.1, -0.2, 9.8]) + 1e-9 * (stamp - logs.BEGIN) * np.array([1, 2, 3])
            imu.append((stamp, make.imu(stamp, force)))
    for i in range(100):
        stamp = logs.BEGIN + 1_300_000 + i * 20_000_000
        field.append((stamp, make.field(stamp, (i, 2 * i, 3 * i))))
    return logs.bag(
        tmp_path / "two.bag",
        "bag",
        {"/imu": ("sensor_msgs/msg/Imu", imu), "/mag": ("sensor_msgs/msg/MagneticField", field)},
    )


def test_the_topic_that_speaks_most_often_is_the_example(tmp_path):
    make = logs.Messages()
    field = [(k, make.field(k, (k, 1, 2))) for k in range(3)]
    imu = [(k, make.imu(k, (0, 0, 9))) for k in range(9)]
    topics = {
        "/mag": ("sensor_msgs/msg/MagneticField", field),
        "/imu": ("sensor_msgs/msg/Imu", imu),
    }
    assert "two.bag:/imu," in error_of(logs.bag(tmp_path / "two.bag", "bag", topics))


def test_several_topics_without_a_choice_are_listed(two_topics):
    said = error_of(two_topics)
    assert f"holds 2 topics; name one behind the file, {two_topics}:/imu" in said
    assert "/imu (sensor_msgs/Imu, 360), /mag (sensor_msgs/MagneticField, 100)" in said


def test_a_misspelt_topic_is_corrected(two_topics):
    said = error_of(f"{two_topics}:/imo")
    assert f"no topic /imo; did you mean {two_topics}:/imu?" in said
    assert "/mag (sensor_msgs/MagneticField, 100)" in said
    assert "named twice" in error_of(f"{two_topics}:/imu,imu")


def test_two_topics_meet_at_the_times_of_the_slower_one_and_it_is_said(two_topics):
    table = read_table(f"{two_topics}:/imu,/mag")
    time = table.columns["t"].values
    # The last flux but none lies beyond the last force; those in the hole have no force.
    flux = table.columns["/mag.magnetic_field.x"].values
    inside = [i for i in range(100) if not 0.995 < i * 0.02 + 0.0013 < 1.2]
    np.testing.assert_array_equal(flux, inside)
    expected = 9.8 + 3 * (time + 0.0013)
    np.testing.assert_allclose(
        table.columns["/imu.linear_acceleration.z"].values, expected, atol=1e-9
    )
    assert "/imu (200 Hz) interpolated linearly at the times of /mag (50 Hz)" in table.notes
    assert f"{100 - len(inside)} samples of /mag left out: another topic has none there" in (
        table.notes
    )


def test_topics_without_a_common_time_are_refused(tmp_path):
    make = logs.Messages()
    early = [(logs.BEGIN + i, make.imu(logs.BEGIN + i, (i, 0, 0))) for i in range(5)]
    late = [
        (logs.BEGIN + 10**9 + i, make.field(logs.BEGIN + 10**9 + i, (i, 0, 0))) for i in range(5)
    ]
    path = logs.bag(
        tmp_path / "a.bag",
        "bag",
        {"/a": ("sensor_msgs/msg/Imu", early), "/b": ("sensor_msgs/msg/MagneticField", late)},
    )
    assert "/a and /b have no time in common; calibrate from one of them" in error_of(
        f"{path}:/a,/b"
    )


def test_between_two_quaternions_of_opposite_sign_lies_the_rotation_between(tmp_path):
    """Turning about x at 1 rad/s; every other quaternion has the other sign: the same rotation."""
    make = logs.Messages()
    imu, field = [], []
    for i in range(50):
        stamp, sign = logs.BEGIN + i * 20_000_000, (-1) ** i
        half = 0.5 * i * 0.02
        q = sign * np.array([np.sin(half), 0, 0, np.cos(half)])
        imu.append((stamp, make.imu(stamp, (0, 0, 9.8), attitude=q, known=True)))
    for i in range(20):
        stamp = logs.BEGIN + 10_000_000 + i * 40_000_000
        field.append((stamp, make.field(stamp, (i, 0, 0))))
    path = logs.bag(
        tmp_path / "a.bag",
        "bag",
        {"/i": ("sensor_msgs/msg/Imu", imu), "/m": ("sensor_msgs/msg/MagneticField", field)},
    )
    table = read_table(f"{path}:/i,/m")
    q = np.stack([table.columns[f"/i.orientation.{p}"].values for p in "xyzw"], axis=1)
    angle = 2 * np.arctan2(q[:, 0] * np.sign(q[:, 3]), np.abs(q[:, 3]))
    np.testing.assert_allclose(angle, table.columns["t"].values + 0.01, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-12)


def test_readings_in_a_bag_are_corrected(sensor, readings, tmp_path):
    path = logs.bag(tmp_path / "a.bag", "bag", {"/imu": logs.imu_topic("bag", readings)})
    out = tmp_path / "out"
    said = ["--columns", V]
    assert run(["calibrate", "norm-triangular", str(path), *said, *G, "-o", str(out)]) == 0
    assert run(["apply", str(out), f"{path}:/imu", *said, "-o", str(tmp_path / "c.csv")]) == 0
    with (tmp_path / "c.csv").open() as file:
        rows = list(csv.reader(file))
    corrected = np.array(rows[1:], dtype=float)[:, -3:]
    np.testing.assert_allclose(np.linalg.norm(corrected, axis=1), 9.80665, atol=0.05)


# -- PX4 logs --------------------------------------------------------------------------------------


def test_a_topic_of_a_px4_log_is_calibrated(sensor, readings, tmp_path):
    time = 5_000_000 + 4000 * np.arange(len(readings))
    path = logs.ulog(
        tmp_path / "log.ulg",
        {
            "sensor_combined": logs.records(
                time,
                gyro_rad=np.zeros((60, 3)),
                accelerometer_timestamp_relative=np.zeros(60, dtype=int),
                accelerometer_m_s2=readings,
            ),
            "sensor_mag": logs.records(time[::10], x=np.arange(6.0)),
        },
    )
    out = tmp_path / "out"
    words = ["calibrate", "norm-triangular", f"{path}:sensor_combined", *G, "-o", str(out)]
    assert run([*words, "--columns", "v=accelerometer_m_s2"]) == 0
    assert_found(json.loads((out / "result.json").read_text(encoding="utf-8")), sensor)
    table = read_table(f"{path}:sensor_combined")
    np.testing.assert_allclose(table.columns["t"].values, 0.004 * np.arange(60), atol=1e-12)
    assert table.columns["accelerometer_m_s2[2]"].unit == "m/s^2"
    assert table.columns["gyro_rad[0]"].unit == "rad/s"
    assert read_table(f"{path}:sensor_mag").columns["x"].unit == "gauss"


def test_instances_of_a_topic_are_told_apart(tmp_path):
    path = logs.ulog(
        tmp_path / "log.ulg",
        {
            f"sensor_accel_{k}": logs.records(1000 * np.arange(4), x=np.full(4, k + 0.5))
            for k in range(2)
        },
        dropout=250,
    )
    assert "sensor_accel_0 (sensor_accel, 4), sensor_accel_1 (sensor_accel, 4)" in error_of(path)
    assert "no topic sensor_accel;" in error_of(f"{path}:sensor_accel")
    table = read_table(f"{path}:sensor_accel_1")
    np.testing.assert_array_equal(table.columns["x"].values, 1.5)
    assert "1 dropouts of the recorder, 0.25 s in all" in table.notes


def test_the_time_of_the_raw_sample_is_preferred(tmp_path):
    sample = 1000 * np.arange(5, dtype=np.uint64) ** 2 + 7
    path = logs.ulog(
        tmp_path / "log.ulg",
        {"sensor_accel": logs.records(sample + 300, timestamp_sample=sample, x=np.arange(5.0))},
    )
    table = read_table(f"{path}:sensor_accel_0")
    np.testing.assert_allclose(table.columns["t"].values, np.arange(5) ** 2 * 1e-3, atol=1e-12)
    assert "time of sensor_accel: timestamp_sample" in table.notes


def test_void_and_late_accelerometer_samples_are_known(tmp_path):
    relative = np.array([0, 2000, 2**31 - 1, 2000])
    path = logs.ulog(
        tmp_path / "log.ulg",
        {
            "sensor_combined": logs.records(
                1000 * np.arange(4),
                accelerometer_timestamp_relative=relative,
                accelerometer_m_s2=np.ones((4, 3)),
            )
        },
    )
    table = read_table(path)
    assert str(table.columns["accelerometer_m_s2[0]"].bad).startswith("row 2")
    assert "accelerometer samples lie +1.33 ms from t on average" in table.notes


# -- ArduPilot logs --------------------------------------------------------------------------------


LOG171 = "ardupilot-log171"


@pytest.mark.parametrize("name", ["MAG", "MAG2", "MAG3"])
def test_a_measured_ardupilot_log_is_what_another_reader_decoded(shared_data, name):
    """The table beside it is of another decoder: offsets subtracted, t since the start."""
    beside = read_table(shared_data / LOG171 / f"{name}_all.csv")
    table = read_table(f"{shared_data / LOG171 / 'log171.bin'}:{name}")
    assert table.n_rows >= beside.n_rows > 2300
    time = beside.columns["t"].values - beside.columns["t"].values[0]
    rows = np.searchsorted(table.columns["t"].values, time - 5e-4)
    np.testing.assert_allclose(table.columns["t"].values[rows], time, atol=1e-9)
    for axis in "xyz":
        raw = (
            table.columns[f"Mag{axis.upper()}"].values - table.columns[f"Ofs{axis.upper()}"].values
        )
        np.testing.assert_array_equal(raw[rows], beside.columns[f"m_{axis}"].values)
        assert table.columns[f"Mag{axis.upper()}"].unit == "mgauss"
    assert table.notes[0] == f"time of {name}: TimeMS"
    corrected = [f"the topic {name}.raw is what the sensor read" in n for n in table.notes[1:]]
    assert corrected == ([] if name == "MAG3" else [True])


@pytest.mark.parametrize(("name", "number"), [("MAG", ""), ("MAG2", "2"), ("MAG3", "3")])
def test_what_a_compass_read_gives_what_was_logged_by_the_autopilots_parameters(
    shared_data, name, number
):
    """D·(reading + COMPASS_OFS), as AP_Compass corrects, is the logged number to its rounding."""
    file = str(shared_data / LOG171 / "log171.bin")
    log, given = DFReader.DFReader_binary(file), {}
    while (message := log.recv_match(type="PARM")) is not None:
        given[message.Name] = message.Value
    log.filehandle.close()
    of = {
        what: [given[f"COMPASS_{what}{number}_{a}"] for a in "XYZ"]
        for what in ("OFS", "DIA", "ODI")
    }
    (a, b, c), D = of["ODI"], np.diag(of["DIA"])
    D += [[0, a, b], [a, 0, c], [b, c, 0]]
    axes = ("MagX", "MagY", "MagZ")
    read, logged = (read_table(f"{file}:{n}").columns for n in (f"{name}.raw", name))
    reading = np.stack([read[a].values for a in axes], axis=1)
    again = (reading + np.array(of["OFS"])) @ D.T
    np.testing.assert_allclose(again, np.stack([logged[a].values for a in axes], axis=1), atol=1e-9)
    assert "OfsX" not in read
    assert read["MagX"].unit == "mgauss"


@pytest.mark.parametrize("name", ["ATT", "GPS", "CURR", "BARO", "IMU2"])
def test_every_number_of_a_measured_log_is_that_of_the_librarys_own_messages(shared_data, name):
    """Message by message, which takes the library 40 times as long."""
    file = shared_data / LOG171 / "log171.bin"
    table = read_table(f"{file}:/{name}")
    log = DFReader.DFReader_binary(str(file))
    messages = []
    while (message := log.recv_match(type=name)) is not None and len(messages) < 1500:
        messages.append(message.to_dict())
    log.filehandle.close()
    assert len(messages) > 1000
    stamps = np.array([message["TimeMS"] for message in messages])
    time = table.columns["t"].values[: len(messages)]
    np.testing.assert_allclose(time, (stamps - stamps[0]) * 1e-3, atol=1e-9)
    for column in set(table.columns) - {"t"}:
        expected = [message[column] for message in messages]
        np.testing.assert_array_equal(table.columns[column].values[: len(messages)], expected)


def test_the_attitude_of_a_measured_log_is_in_degrees(shared_data):
    log = shared_data / LOG171 / "log171.bin"
    alone, beside = read_table(f"{log}:ATT"), read_table(shared_data / LOG171 / "MAG_all.csv")
    assert [alone.columns[name].unit for name in ("Roll", "Pitch", "Yaw")] == ["deg"] * 3
    assert alone.columns["Roll"].values[0] == beside.columns["roll"].values[0]
    shared = read_table(f"{log}:MAG,ATT")
    assert "MAG (9.901 Hz) interpolated linearly at the times of ATT (9.901 Hz)" in shared.notes


@pytest.mark.parametrize("low", [0, -180])
def test_angles_are_interpolated_the_short_way_round(tmp_path, low):
    """Yaw at 10 Hz turns through north at 20 degrees a second; the flux lies halfway between."""
    turning = 300 + 2.0 * np.arange(100)
    written = (turning - low) % 360 + low
    path = logs.dataflash(
        tmp_path / "a.bin",
        {
            "ATT": ("Qcf", "TimeUS,Roll,Yaw", "", "",
                    [(k * 100_000, 100, yaw) for k, yaw in enumerate(written)]),
            "MAG": ("Qh", "TimeUS,MagX", "", "",
                    [(k * 300_000 + 50_000, k) for k in range(33)]),
        },
    )  # fmt: skip
    yaw = read_table(f"{path}:MAG,ATT").columns["ATT.Yaw"].values
    off = (yaw - (300 + 2.0 * (0.5 + 3 * np.arange(33))) + 180) % 360 - 180
    np.testing.assert_allclose(off, 0, atol=1e-4)
    assert yaw.min() >= low - 2
    assert yaw.max() <= low + 362


KINDS = {
    "MAG": (
        "QBhhhc", "TimeUS,I,MagX,MagY,MagZ,Temp", "s#GGGO", "F-CCC0",
        [(k * 100_000 + 7, i, 100 * i + k, -k, 3, 2050) for k in range(20) for i in range(2)],
    ),
    "BAT": (
        "QBfLN", "TimeUS,Inst,Volt,Where,Name", "s#vD-", "F-0G-",
        [(k * 50_000, 0, 12.5, 471234567, b"main") for k in range(40)],
    ),
}  # fmt: skip
UNITS = {
    "s": "s",
    "G": "Gauss",
    "O": "degC",
    "v": "V",
    "D": "deglatitude",
    "-": "",
    "#": "instance",
}
MULTIPLIERS = {"F": 1e-6, "C": 1e-3, "0": 1.0, "-": 0.0, "G": 1e-7}


def test_units_multipliers_and_instances_are_as_the_log_states_them(tmp_path):
    path = logs.dataflash(tmp_path / "a.bin", KINDS, UNITS, MULTIPLIERS)
    assert "MAG[0] (MAG, 20), MAG[1] (MAG, 20), BAT (40)" in error_of(path)
    assert "no topic MAG; did you mean" in error_of(f"{path}:MAG")
    table = read_table(f"{path}:MAG[1]")
    np.testing.assert_allclose(table.columns["MagX"].values, (100 + np.arange(20)) * 1e-3)
    np.testing.assert_allclose(table.columns["t"].values, np.arange(20) * 0.1, atol=1e-12)
    units = {name: column.unit for name, column in table.columns.items()}
    assert units == {"t": "s", **dict.fromkeys(("MagX", "MagY", "MagZ"), "Gauss"), "Temp": "degC"}
    assert table.columns["Temp"].values[0] == 20.5
    battery = read_table(f"{path}:/BAT[0]")
    assert battery.columns["Where"].values[0] == 47.1234567
    assert (battery.columns["Where"].unit, battery.columns["Volt"].unit) == ("deg", "V")
    assert list(battery.columns) == ["t", "Volt", "Where"]
    assert "no topic BAT[1]; did you mean" in error_of(f"{path}:BAT[1]")


def test_an_ardupilot_log_is_calibrated(sensor, readings, tmp_path):
    rows = [(20_000 * k, 0, *row) for k, row in enumerate(readings)]
    path = logs.dataflash(
        tmp_path / "log.bin",
        {"IMU": ("QBfff", "TimeUS,I,AccX,AccY,AccZ", "s#ooo", "F-000", rows)},
        {"s": "s", "o": "m/s/s", "#": "instance"},
        {"F": 1e-6, "0": 1.0, "-": 0.0},
    )
    out = tmp_path / "out"
    words = ["calibrate", "norm-triangular", f"{path}:IMU", "--columns", "v=Acc", *G]
    assert run([*words, "-o", str(out)]) == 0
    assert_found(json.loads((out / "result.json").read_text(encoding="utf-8")), sensor)


COMPASS = {
    **{f"COMPASS_OFS_{a}": v for a, v in zip("XYZ", (12, -30, 5), strict=True)},
    **{f"COMPASS_OFS2_{a}": v for a, v in zip("XYZ", (-80, 40, 60), strict=True)},
    **{f"COMPASS_DIA2_{a}": v for a, v in zip("XYZ", (1.1, 0.95, 1.02), strict=True)},
    **{f"COMPASS_ODI2_{a}": v for a, v in zip("XYZ", (0.02, -0.01, 0.03), strict=True)},
}


def compass_log(path, parameters, offset=(-80, 40, 60)):
    """A log of today's form, in gauss, of the second compass; motors add (7, 8, -9) mGauss."""
    rng = np.random.default_rng(5)
    reading = 400 * rng.standard_normal((30, 3))
    D = np.array([[1.1, 0.02, -0.01], [0.02, 0.95, 0.03], [-0.01, 0.03, 1.02]])
    logged = (reading + np.array([-80, 40, 60])) @ D + np.array([7, 8, -9])
    rows = [(k * 100_000, 1, *logged[k], *offset, 7, 8, -9) for k in range(30)]
    axes = [f"{what}{a}" for what in ("Mag", "Ofs", "MO") for a in "XYZ"]
    kinds = {
        "PARM": ("QNf", "TimeUS,Name,Value", "s--", "F--",
                 [(k, name.encode(), float(v)) for k, (name, v) in enumerate(parameters)]),
        "MAG": ("QBfffffffff", f"TimeUS,I,{','.join(axes)}", "s#" + 9 * "G", "F-" + 9 * "C", rows),
    }  # fmt: skip
    return logs.dataflash(path, kinds, UNITS, MULTIPLIERS), reading


def test_motors_and_a_matrix_are_taken_off_a_compass_in_gauss(tmp_path):
    path, reading = compass_log(tmp_path / "a.bin", COMPASS.items())
    table = read_table(f"{path}:MAG[1].raw")
    found = np.stack([table.columns[f"Mag{a}"].values for a in "XYZ"], axis=1)
    np.testing.assert_allclose(found, 1e-3 * reading, atol=1e-7)
    assert "what motors add, the matrix COMPASS_DIA and ODI taken off" in table.notes[-1]


def test_where_a_log_does_not_tell_what_a_compass_read_that_is_said(tmp_path):
    anew = [*COMPASS.items(), ("COMPASS_DIA2_X", 1.2)]
    path = compass_log(tmp_path / "a.bin", anew)[0]
    assert "COMPASS_DIA2_X was set anew within the log, from 1.1 to 1.2" in error_of(
        f"{path}:MAG.raw"
    )
    assert "MAG.raw is what the sensor read" in read_table(f"{path}:MAG").notes[-1]
    path = compass_log(tmp_path / "b.bin", COMPASS.items(), offset=(1, 2, 3))[0]
    assert "offsets 1, 2, 3 are not those of one compass" in error_of(f"{path}:MAG.raw")
    path = logs.dataflash(tmp_path / "c.bin", KINDS, UNITS, MULTIPLIERS)
    assert "name BAT" in error_of(f"{path}:BAT.raw")


def test_parameters_for_an_autopilot_are_not_made_of_readings_it_had_corrected(
    sensor, readings, tmp_path, capsys
):
    turned = [(20_000 * k, *(50 * row), 30, 0, 0) for k, row in enumerate(readings)]
    fields = "TimeUS,MagX,MagY,MagZ,OfsX,OfsY,OfsZ"
    rows = {"MAG": ("Qffffff", fields, "sGGGGGG", "FCCCCCC", turned)}
    path = logs.dataflash(tmp_path / "a.bin", rows, UNITS, MULTIPLIERS)
    norm = ["--set", "norm=490 mgauss"]
    found = {}
    for topic in ("MAG", "MAG.raw"):
        words = ["calibrate", "norm-triangular", f"{path}:{topic}", "--columns", "v=Mag", *norm]
        assert run([*words, "-o", str(tmp_path / topic)]) == 0
        found[topic] = run(
            ["export", str(tmp_path / topic), "--to", "ardupilot", "-o", str(tmp_path / "c.param")]
        )
    assert found == {"MAG": 1, "MAG.raw": 0}
    assert (
        "corrected them, with OfsX 0.03; its parameters are for what the sensor reads"
        in capsys.readouterr().err
    )
    for topic, code in (("MAG", 1), ("MAG.raw", 0)):
        for words in (["apply"], ["check", *norm]):
            given = [
                words[0],
                str(tmp_path / "c.param"),
                f"{path}:{topic}",
                "--columns",
                "m=Mag",
                *words[1:],
            ]
            assert run(given) == code, given


def test_a_cut_ardupilot_log_is_read_as_far_as_it_goes_and_garbage_is_skipped(tmp_path, capfd):
    path = logs.dataflash(tmp_path / "a.bin", KINDS, UNITS, MULTIPLIERS)
    content = path.read_bytes()
    path.write_bytes(content[:-200])
    table = read_table(f"{path}:BAT")
    assert 20 < table.n_rows < 40
    assert any("bytes are cut or damaged, not read" in note for note in table.notes)
    middle = len(content) - 700
    path.write_bytes(content[:middle] + bytes(33) + content[middle:])
    assert any("bytes are cut or damaged, not read" in n for n in read_table(f"{path}:BAT").notes)
    path.write_bytes(b"\xa3\x95" + bytes(range(256)) * 4)
    assert "cannot be read as an ArduPilot log" in error_of(path)
    path.write_bytes(content[:4])
    assert "ArduPilot log" in error_of(path)
    assert capfd.readouterr() == ("", "")


def test_a_bin_file_that_is_no_log_is_read_as_what_it_is(tmp_path):
    (tmp_path / "a.bin").write_text("vx,vy,vz\n1,2,3\n4,5,6\n")
    assert list(read_table(tmp_path / "a.bin").columns) == ["vx", "vy", "vz"]
    (tmp_path / "b.bin").write_bytes(bytes(range(256)))
    assert "is no text but binary" in error_of(tmp_path / "b.bin")


# -- what can be wrong -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "module", "extra"),
    [
        ("a.bag", "rosbags.highlevel", "ros"),
        ("a.ulg", "pyulog", "px4"),
        ("a.bin", "pymavlink.DFReader", "ardupilot"),
    ],
)
def test_the_library_that_is_missing_is_named_with_its_command(
    name, module, extra, tmp_path, monkeypatch, capsys
):
    (tmp_path / name).write_bytes(b"\xa3\x95 anything")
    monkeypatch.setitem(sys.modules, module, None)
    assert run(["calibrate", "norm-triangular", str(tmp_path / name)]) == 1
    said = capsys.readouterr().err
    assert f"needs the library {module.partition('.')[0]}: pip install 'casest[{extra}]'" in said


@pytest.mark.parametrize("share", [0.0005, 0.3, 0.9, 0.995, 0.999])
@pytest.mark.parametrize("form", ["bag", "mcap", "sqlite3"])
def test_a_bag_that_is_cut_off_is_an_error_with_a_way_out(form, share, readings, tmp_path):
    whole = logs.bag(tmp_path / ("a.bag" if form == "bag" else "a"), form,
                     {"/imu": logs.imu_topic(form, readings)})  # fmt: skip
    file = {"bag": whole, "mcap": whole / "a.mcap", "sqlite3": whole / "a.db3"}[form]
    content = file.read_bytes()
    file.write_bytes(content[: max(1, int(share * len(content)))])
    assert "cannot be read as a ROS bag" in error_of(file)


def cut_off(path) -> bool:
    return any("bytes are cut or damaged, not read" in note for note in read_table(path).notes)


def test_a_px4_log_that_is_none_is_refused_and_a_cut_one_read_as_far_as_it_goes(tmp_path, capsys):
    path = logs.ulog(
        tmp_path / "a.ulg", {"sensor_mag": logs.records(1000 * np.arange(50), x=np.arange(50.0))}
    )
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    values = read_table(path).columns["x"].values
    assert 20 < len(values) < 30
    np.testing.assert_array_equal(values, np.arange(len(values)))
    assert cut_off(path)
    middle = len(content) // 2
    path.write_bytes(content[:middle] + b"\xff" * 40 + content[middle + 40 :])
    assert cut_off(path)
    path.write_bytes(content[:middle] + bytes(40) + content[middle + 40 :])
    assert "the file is damaged: what could not be read was skipped" in read_table(path).notes
    path.write_bytes(content)
    assert not cut_off(path)
    path.write_bytes(b"no log at all, but long enough for a header")
    assert "cannot be read as a PX4 log" in error_of(path)
    assert capsys.readouterr().out == ""  # the library prints; a table must not hold that


def test_a_topic_behind_a_table_makes_no_sense(tmp_path):
    (tmp_path / "a.csv").write_text("vx,vy,vz\n1,2,3\n4,5,6\n")
    assert "holds no topics; leave ':/imu' out" in error_of(f"{tmp_path / 'a.csv'}:/imu")


def test_a_log_that_is_not_there_is_named(tmp_path):
    assert "no such file" in error_of(f"{tmp_path / 'b.bag'}:/imu")


def test_other_files_need_neither_library(tmp_path):
    (tmp_path / "a.csv").write_text("vx,vy,vz\n1,2,3\n4,5,6\n")
    code = (
        "import sys; from casest.data import read_table; "
        f"read_table({str(tmp_path / 'a.csv')!r}); "
        "print({'rosbags', 'pyulog', 'pymavlink', 'h5py'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"

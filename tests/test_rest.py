"""Rest intervals: found where a simulator put them, on measured records, and nowhere else."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casest.data import Run, at_rest, load_runs
from casest.data.rest import standard_error
from casest.data.stillness import find_rests
from casest.declaration.symbols import Signal
from casest.errors import DataError, UsageError

V = Signal("v", 3, None)


@dataclass(frozen=True)
class Simulated:
    """A hand-held record (N, 3) with the rests (first, last) that were put in."""

    values: np.ndarray
    rests: list[tuple[int, int]]
    gravity: np.ndarray


def directions(n: int, rng: np.random.Generator) -> np.ndarray:
    d = rng.normal(size=(n, 3))
    return 9.81 * d / np.linalg.norm(d, axis=1)[:, None]


def hand_held(
    n_rests: int = 12,
    noise: float = 0.05,
    rest: int = 300,
    seed: int = 0,
    per_axis: tuple[float, float, float] = (1.0, 1.0, 1.5),
) -> Simulated:
    """Rests with white noise; between them the hand turns the sensor and shakes it."""
    rng = np.random.default_rng(seed)
    gravity = directions(n_rests, rng)
    parts, rests, at = [], [], 0
    for k in range(n_rests):
        length = rest + int(rng.integers(0, rest // 2))
        rests.append((at, at + length - 1))
        parts.append(np.tile(gravity[k], (length, 1)))
        at += length
        if k + 1 < n_rests:
            move = int(rng.integers(60, 140))
            way = (1 - np.cos(np.linspace(0, np.pi, move)))[:, None] / 2
            shake = rng.normal(size=(move, 3)) * 2.0 * np.sin(np.linspace(0, np.pi, move))[:, None]
            parts.append(gravity[k] * (1 - way) + gravity[k + 1] * way + shake)
            at += move
    values = np.concatenate(parts)
    values = values + noise * np.array(per_axis) * rng.normal(size=values.shape)
    return Simulated(values, rests, gravity)


def raw(values: np.ndarray, rate: float | None = 100.0, name: str = "hand") -> Run:
    time = None if rate is None else np.arange(len(values)) / rate
    return Run.raw(name, {"v": values}, units={"v": "m/s^2"}, time=time)


def spans(run: Run) -> list[tuple[int, int]]:
    return [
        (int(a), int(b))
        for a, b in zip(run.columns["first_row"], run.columns["last_row"], strict=True)
    ]


def overlap(a: tuple[int, int], b: tuple[int, int]) -> int:
    return max(0, min(a[1], b[1]) - max(a[0], b[0]) + 1)


def assert_found(found: Run, truth: Simulated, share: float = 0.7) -> None:
    """Each rest is found once, most of it, and nothing of the motion with it."""
    assert len(found) == len(truth.rests)
    for span, rest in zip(spans(found), truth.rests, strict=True):
        assert overlap(span, rest) >= share * (rest[1] - rest[0] + 1)
        # half a window: motion begins and ends smoothly, and noise hides its first samples
        assert rest[0] - 12 <= span[0] < span[1] <= rest[1] + 12


@pytest.mark.parametrize("noise", [1e-4, 0.01, 0.05, 0.2])
@pytest.mark.parametrize("rate", [100.0, None])
def test_every_rest_is_found_once_at_any_noise(noise: float, rate: float | None) -> None:
    truth = hand_held(noise=noise)
    assert_found(at_rest(raw(truth.values, rate)), truth)


@pytest.mark.parametrize("seed", range(8))
def test_every_rest_is_found_in_other_records_too(seed: int) -> None:
    truth = hand_held(n_rests=20, seed=100 + seed)
    assert_found(at_rest(raw(truth.values)), truth)


def test_rests_without_any_noise_are_found() -> None:
    truth = hand_held(noise=0.0)
    assert_found(at_rest(raw(truth.values)), truth)


@pytest.mark.parametrize("resolution", [0.01, 0.1, 0.3])
@pytest.mark.parametrize("noise", [0.02, 0.1])
def test_coarse_readings_do_not_hide_rests(resolution: float, noise: float) -> None:
    truth = hand_held(noise=noise)
    coarse = np.round(truth.values / resolution) * resolution
    assert_found(at_rest(raw(coarse)), truth)


@pytest.mark.parametrize("share", [4, 1])
def test_little_rest_and_little_motion_are_told_apart(share: int) -> None:
    truth = hand_held(n_rests=10, rest=60 * share)
    assert_found(at_rest(raw(truth.values), window=15), truth, share=0.6)


def test_axes_of_very_different_noise_count_alike() -> None:
    truth = hand_held(per_axis=(0.1, 1.0, 20.0), noise=0.02)
    assert_found(at_rest(raw(truth.values)), truth)


@given(
    st.floats(1e-6, 1e6),
    st.tuples(*[st.floats(-100, 100)] * 3),
    st.permutations([0, 1, 2]),
)
@settings(max_examples=15, deadline=None)
def test_units_offsets_and_the_order_of_axes_do_not_matter(
    scale: float, offset: tuple[float, float, float], order: list[int]
) -> None:
    truth = hand_held(n_rests=6, rest=150)
    here = find_rests(truth.values, np.zeros(len(truth.values), dtype=int))
    moved = scale * (truth.values + np.array(offset))[:, order]
    there = find_rests(moved, np.zeros(len(moved), dtype=int))
    assert len(here.intervals) == len(there.intervals)
    for a, b in zip(here.intervals, there.intervals, strict=True):
        assert abs(a.first - b.first) <= 1  # rounding may move a sample across a threshold
        assert abs(a.last - b.last) <= 1


def test_means_are_the_positions_and_their_errors_are_as_stated() -> None:
    truth = hand_held(n_rests=40, seed=5)
    found = at_rest(raw(truth.values))
    error = (found.signals["v"] - truth.gravity) / found.spread["v"]
    assert found.units["v"] == "m/s^2"
    # 120 standardised errors: their rms is 1 within 4 standard deviations, 4/sqrt(2*120)
    assert np.sqrt((error**2).mean()) == pytest.approx(1.0, abs=0.26)
    assert np.abs(error).max() < 5


def test_a_rest_run_counts_its_samples_and_numbers_its_intervals() -> None:
    truth = hand_held()
    found = at_rest(raw(truth.values))
    assert found.rows.tolist() == list(range(12))
    assert found.block.tolist() == list(range(12))
    for (first, last), count in zip(spans(found), found.count, strict=True):
        assert last - first + 1 == count
    covered = int(found.count.sum())
    n = len(truth.values)
    share = f"{100 * covered / n:.0f} %"
    assert f"12 rest intervals found, {covered} of {n} samples ({share})" in found.notes


def test_the_noise_at_rest_is_reported_per_axis() -> None:
    found = at_rest(raw(hand_held(noise=0.05).values))
    (note,) = [note for note in found.notes if note.startswith("noise at rest")]
    sigma = [float(part.split()[-1]) for part in note.removeprefix("noise at rest: ").split(",")]
    assert sigma == pytest.approx([0.05, 0.05, 0.075], rel=0.05)


def test_the_error_of_a_mean_grows_with_autocorrelation() -> None:
    rng = np.random.default_rng(7)
    n, phi, records = 600, 0.9, 200
    x = np.zeros((records, n))
    x[:, 0] = rng.normal(size=records) / np.sqrt(1 - phi**2)
    for i in range(1, n):
        x[:, i] = phi * x[:, i - 1] + rng.normal(size=records)
    true = x.mean(axis=1).std()
    stated = np.sqrt(np.mean([standard_error(row) ** 2 for row in x]))
    assert stated == pytest.approx(true, rel=0.25)
    white = rng.normal(size=n)
    assert standard_error(white) == pytest.approx(1 / np.sqrt(n), rel=0.3)


def test_averaging_does_not_beat_a_coarse_resolution() -> None:
    assert standard_error(np.full(400, 3.0), step=0.5) == pytest.approx(0.5 / np.sqrt(12))
    fine = np.random.default_rng(0).normal(size=400)
    assert standard_error(fine, step=0.5) == standard_error(fine)


def test_two_visits_to_one_orientation_stay_apart() -> None:
    rng = np.random.default_rng(2)
    pose = np.tile([0.0, 0.0, 9.81], (400, 1))
    lift = np.tile([0.0, 0.0, 9.81], (80, 1)) + 2 * rng.normal(size=(80, 3))
    values = np.concatenate([pose, lift, pose]) + 0.05 * rng.normal(size=(880, 3))
    found = at_rest(raw(values))
    assert len(found) == 2
    np.testing.assert_allclose(found.signals["v"][0], found.signals["v"][1], atol=0.02)


def test_positions_without_motion_between_them_stay_apart() -> None:
    rng = np.random.default_rng(3)
    gravity = directions(15, rng)
    values = np.repeat(gravity, 100, axis=0) + 0.03 * rng.normal(size=(1500, 3))
    found = at_rest(raw(values, rate=None))
    assert len(found) == 15
    np.testing.assert_allclose(found.signals["v"], gravity, atol=0.02)


def test_a_knock_on_the_table_ends_no_rest() -> None:
    truth = hand_held(n_rests=6)
    values = truth.values.copy()
    rng = np.random.default_rng(4)
    middle = truth.rests[2][0] + 150
    values[middle : middle + 4] += 0.15 * rng.normal(size=(4, 3))
    assert_found(at_rest(raw(values)), replace(truth, values=values))


def creeping(truth: Simulated, k: int, start: float, change: float) -> np.ndarray:
    """Let rest k creep by `change` (m/s^2 on x) from the fraction `start` of it to its end."""
    values = truth.values.copy()
    first, last = truth.rests[k]
    begin = first + int(start * (last - first))
    values[begin : last + 1, 0] += np.linspace(0, change, last + 1 - begin)
    return values


def test_a_rest_that_creeps_throughout_is_dropped_and_counted() -> None:
    truth = hand_held(n_rests=8, rest=400)
    found = at_rest(raw(creeping(truth, 3, start=0.0, change=1.0)))
    assert len(found) == 7
    assert not any(overlap(span, truth.rests[3]) for span in spans(found))
    assert "1 quiet stretches dropped: they drift all the time" in found.notes


def test_a_rest_that_creeps_at_its_end_is_shortened_and_counted() -> None:
    truth = hand_held(n_rests=8, rest=400)
    found = at_rest(raw(creeping(truth, 3, start=0.6, change=0.8)))
    assert len(found) == 8
    first, last = truth.rests[3]
    assert spans(found)[3][1] < first + 0.8 * (last - first)
    assert "1 rest intervals shortened: they drift at one end" in found.notes
    assert found.signals["v"][3] == pytest.approx(truth.gravity[3], abs=0.03)


def test_a_rest_never_crosses_a_gap() -> None:
    values = np.random.default_rng(0).normal(size=(600, 3))
    run = replace(raw(values), block=np.repeat([0, 1, 2], [250, 10, 340]))
    assert [(a < 250) == (b < 250) for a, b in spans(at_rest(run))] == [True, True]
    assert len(at_rest(run)) == 2


def test_further_columns_must_be_still_too() -> None:
    truth = hand_held(n_rests=6)
    gyro = 0.01 * np.random.default_rng(1).normal(size=len(truth.values))
    for k, (first, last) in enumerate(truth.rests):
        gyro[last + 1 : last + 60] += 1.0
        if k == 4:  # turned about the vertical: only the gyro sees it
            gyro[first + 100 : first + 180] += np.sin(np.linspace(0, np.pi, 80))
    run = replace(raw(truth.values), columns={"gz": gyro}, column_units={"gz": "rad/s"})
    assert len(at_rest(run)) == 6
    with_gyro = at_rest(run, also=["gz"])
    turned = (truth.rests[4][0] + 110, truth.rests[4][0] + 170)
    assert not any(overlap(span, turned) for span in spans(with_gyro))
    assert len(with_gyro) == 7


def test_a_temperature_may_drift_while_the_sensor_rests() -> None:
    truth = hand_held(n_rests=6)
    warming = np.linspace(20.0, 30.0, len(truth.values))[:, None]
    run = raw(truth.values)
    run = replace(run, signals={**run.signals, "temperature": warming})
    found = at_rest(run)
    assert_found(found, truth)
    assert found.signals["temperature"].shape == (6, 1)


def test_a_long_record_at_rest_is_one_rest() -> None:
    values = np.random.default_rng(0).normal(size=(300_000, 3))
    assert len(at_rest(raw(values))) == 1


def test_labels_survive_where_an_interval_has_only_one() -> None:
    truth = hand_held(n_rests=3)
    labels = np.full(len(truth.values), "a")
    labels[truth.rests[1][0] + 50 :] = "b"
    run = replace(raw(truth.values), columns={"part": labels}, column_units={"part": None})
    assert at_rest(run).columns["part"].tolist() == ["a", "", "b"]


def turning(noise: float, speed: float) -> np.ndarray:
    """A sensor on a wheel that never stops."""
    t = np.arange(6000) / 100
    clean = np.stack([9.81 * np.cos(speed * t), 9.81 * np.sin(speed * t), 0 * t + 0.5], axis=1)
    return clean + noise * np.random.default_rng(0).normal(size=clean.shape)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05, 0.5])
@pytest.mark.parametrize("speed", [0.2, 2.0, 6.0])
def test_a_record_always_in_motion_holds_no_rest(noise: float, speed: float) -> None:
    with pytest.raises(DataError, match=r"hand: .*(no rest interval|rest cannot be told)") as e:
        at_rest(raw(turning(noise, speed)))
    assert "leave --at-rest out" in str(e.value)


def test_a_record_too_short_to_look_for_rest_is_refused() -> None:
    with pytest.raises(DataError, match="no stretch of 50 samples without a gap"):
        at_rest(raw(np.random.default_rng(0).normal(size=(20, 3))))


def test_what_cannot_be_averaged_is_refused() -> None:
    found = at_rest(raw(hand_held().values))
    with pytest.raises(UsageError, match="is averaged already"):
        at_rest(found)
    run = Run.raw("x", {"t": np.zeros((90, 1))}, units={"t": "s"})
    with pytest.raises(UsageError, match="no signal to look for rest in"):
        at_rest(run)
    with pytest.raises(UsageError, match="no column gz of numbers"):
        at_rest(raw(hand_held().values), also=["gz"])


# --- measured records --------------------------------------------------------------------------


def rests_of(file: Path, columns: str) -> Run:
    (run,) = load_runs([file], [V], columns={"v": columns}, at_rest=True)
    return run


@pytest.mark.parametrize("unit", [0, 1, 2])
def test_twenty_two_or_three_positions_are_found_in_each_mpu9150_record(
    shared_data: Path, unit: int
) -> None:
    found = rests_of(shared_data / "mpu9150-mikoff" / f"imu{unit}.log", "0,1,2")
    assert len(found) in (22, 23)
    assert found.count.sum() > 0.7 * 15900
    length = np.linalg.norm(found.signals["v"], axis=1)
    np.testing.assert_allclose(length, 9.8, atol=1.0)  # uncalibrated, but gravity and nothing else


def test_the_ten_positions_of_the_mpu6050_record_are_found(shared_data: Path) -> None:
    folder = shared_data / "mpu6050-tomisuarez"
    reference = np.loadtxt(folder / "ref_static_intervals.csv", delimiter=",").astype(int)
    found = rests_of(folder / "example_data_calibration.csv", "ax,ay,az")
    assert len(found) == reference.shape[1] == 10
    for span, (first, last) in zip(spans(found), reference.T, strict=True):
        # the reference keeps 3 samples of the second position, before ours
        assert overlap(span, (first - 60, last + 60)) > 0


def test_the_six_positions_of_the_ferraris_session_are_found(shared_data: Path) -> None:
    folder = shared_data / "imucal"
    reference = json.loads((folder / "example_ferraris_session_list.json").read_text())
    found = rests_of(folder / "example_ferraris_session.csv", "acc_x,acc_y,acc_z")
    for part in ("x_p", "x_a", "y_p", "y_a", "z_p", "z_a"):
        first, last = reference[part]["start"], reference[part]["end"]
        (inside,) = [span for span in spans(found) if overlap(span, (first, last))]
        assert inside[0] <= first
        assert last - 1 <= inside[1]


def test_a_hundred_and_fifty_positions_of_a_hundred_samples_are_told_apart(
    shared_data: Path,
) -> None:
    found = rests_of(shared_data / "ckexplorer" / "acc_log.csv", "ax,ay,az")
    assert 145 <= len(found) <= 160  # 160 recordings of 100 samples, joined end to end
    for first, last in spans(found):
        assert first // 100 == last // 100
    np.testing.assert_allclose(np.linalg.norm(found.signals["v"], axis=1), 1.0, atol=0.05)


def test_a_magnetometer_turned_without_stop_has_no_rest(shared_data: Path) -> None:
    with pytest.raises(DataError, match="rest"):
        rests_of(shared_data / "ckexplorer" / "acc_mag_log.csv", "mx,my,mz")


def test_a_record_all_at_rest_is_one_interval(shared_data: Path) -> None:
    file = shared_data / "mpu6050-tomisuarez" / "example_data_tinit_calc.csv"
    found = rests_of(file, "ax,ay,az")
    assert len(found) == 1
    assert found.count[0] > 0.95 * 44930

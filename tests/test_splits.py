"""Folds for held-out tests: contiguous, interleaved, whole poses and bursts, reproducible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from casest.data import Run, interleaved_blocks
from casest.errors import DataError, UsageError


def run_of(block: np.ndarray, count: int = 1) -> Run:
    n = len(block)
    values = np.arange(3.0 * n).reshape(n, 3)
    run = Run.raw("r", {"v": values}, units={"v": None}, time=np.arange(float(n)))
    return replace(run, block=np.asarray(block), count=np.full(n, count))


def stretches(fold: np.ndarray) -> list[int]:
    """Lengths of the stretches of one fold."""
    ends = np.flatnonzero(np.r_[fold[1:] != fold[:-1], True])
    return np.diff(np.r_[-1, ends]).tolist()


@given(st.integers(40, 500), st.integers(2, 5), st.integers(0, 100))
def test_a_time_series_is_cut_into_interleaved_stretches(n: int, folds: int, seed: int) -> None:
    fold = interleaved_blocks(run_of(np.zeros(n, int)), n_blocks=20, folds=folds, seed=seed)
    assert set(fold) == set(range(folds))
    assert min(stretches(fold)) >= n // 20
    # no fold is left out for longer than two rounds: none is the end of the record
    assert max(stretches(fold)) <= 2 * (n // 20 + 1)
    sizes = np.bincount(fold)
    assert sizes.max() - sizes.min() <= 20 // folds + (n // 20 + 1)  # stretches differ by one


def test_no_single_samples_of_a_time_series_are_held_out() -> None:
    fold = interleaved_blocks(run_of(np.zeros(11, int)), n_blocks=20)
    assert min(stretches(fold)) >= 2


@pytest.mark.parametrize("count", [1, 50])
def test_poses_and_rest_intervals_stay_whole(count: int) -> None:
    block = np.repeat(np.arange(12), [3, 1, 7, 5, 2, 9, 4, 4, 6, 1, 3, 8])
    fold = interleaved_blocks(run_of(block, count), folds=3)
    for pose in range(12):
        assert len(set(fold[block == pose])) == 1
    assert np.bincount([fold[block == p][0] for p in range(12)]).tolist() == [4, 4, 4]


def test_rest_intervals_of_one_sample_each_may_be_split_one_by_one() -> None:
    fold = interleaved_blocks(run_of(np.arange(3), count=40), folds=2)
    assert set(fold) == {0, 1}


def test_a_single_accidental_gap_does_not_decide_the_folds() -> None:
    block = np.repeat([0, 1], [700, 300])
    fold = interleaved_blocks(run_of(block), n_blocks=20)
    assert set(fold[block == 0]) == set(fold[block == 1]) == {0, 1}
    assert max(stretches(fold)) <= 150


def test_the_same_seed_gives_the_same_folds_and_another_does_not() -> None:
    run = run_of(np.zeros(400, int))
    first = interleaved_blocks(run, seed=1)
    np.testing.assert_array_equal(first, interleaved_blocks(run, seed=1))
    assert (first != interleaved_blocks(run, seed=2)).any()


def test_too_little_to_split_is_refused() -> None:
    with pytest.raises(DataError, match="1 samples in 1 stretches cannot be split into 2 folds"):
        interleaved_blocks(run_of(np.zeros(1, int)))
    with pytest.raises(DataError, match="give a longer record or more positions"):
        interleaved_blocks(run_of(np.arange(2), count=9), folds=3, n_blocks=3)


def test_fewer_than_two_folds_are_refused() -> None:
    with pytest.raises(UsageError, match="1 folds of 20 blocks"):
        interleaved_blocks(run_of(np.zeros(9, int)), folds=1)

"""Files that are broken in every way a file can be: a sentence, never a traceback, never a hang.

A seeded fuzzer: good files of each format are cut, flipped, spliced and renamed, and read with
`read_table` and `load_runs`.
"""

from __future__ import annotations

import gzip
import io
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import h5py
import logs
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import scipy.io

from casest.data import load_runs, read_table
from casest.declaration.symbols import Signal
from casest.errors import CasestError

SIGNALS = [Signal("t", 1, "s"), Signal("v", 3, None)]
FILES, SOME = 2000, 200

TIME = np.arange(40) * 0.01
VALUES = np.random.default_rng(0).normal(size=(40, 3)).round(4)


def text(sign: str = ",", point: str = ".", header: str = "t [s]{0}vx{0}vy{0}vz{0}part") -> bytes:
    lines = [header.format(sign)] if header else []
    for k, (t, v) in enumerate(zip(TIME, VALUES, strict=True)):
        cells = [f"{x:.4f}".replace(".", point) for x in (t, *v)]
        lines.append(sign.join([*cells, "ab"[k % 2]]))
    return "\n".join(lines).encode() + b"\n"


def saved(write: Callable[[io.BytesIO], object]) -> bytes:
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def matlab_73() -> bytes:
    stream = io.BytesIO()
    with h5py.File(stream, "w", userblock_size=512) as store:
        store["t"], store["v"] = TIME[None], VALUES.T
    raw = bytearray(stream.getvalue())
    raw[:124] = b"MATLAB 7.3 MAT-file".ljust(124)
    return bytes(raw)


def parquet() -> bytes:
    names = {"t": TIME, **{f"v{a}": VALUES[:, k] for k, a in enumerate("xyz")}}
    table = pyarrow.table({**names, "part": ["a", "b"] * 20})
    return saved(lambda stream: pyarrow.parquet.write_table(table, stream))


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, bytes]]:
    """Whole files by ending: each is read without an error."""
    folder = tmp_path_factory.mktemp("good")
    rows = [(round(t * 1e6), *map(float, v)) for t, v in zip(TIME, VALUES, strict=True)]
    kinds = {"V": ("Qfff", "TimeUS,vx,vy,vz", "", "", rows)}
    logs.dataflash(folder / "log.bin", kinds)
    everything = np.column_stack([TIME, VALUES])
    return [
        (".csv", text()),
        (".csv", text(";", ",")),
        (".txt", text("\t")),
        (".csv", text(header="")),
        (".csv", text().decode().encode("utf-16")),
        (".csv.gz", gzip.compress(text(), mtime=0)),
        (".npy", saved(lambda s: np.save(s, everything))),
        (".npz", saved(lambda s: np.savez(s, t=TIME, v=VALUES))),
        (".npz", saved(lambda s: np.savez_compressed(s, t=TIME, v=VALUES))),
        (".mat", saved(lambda s: scipy.io.savemat(s, {"t": TIME, "v": VALUES}))),
        (".mat", saved(lambda s: scipy.io.savemat(s, {"t": TIME, "v": VALUES}, format="4"))),
        (
            ".mat",
            saved(lambda s: scipy.io.savemat(s, {"t": TIME, "v": VALUES}, do_compression=True)),
        ),
        (".mat", matlab_73()),
        (".parquet", parquet()),
        (".bin", (folder / "log.bin").read_bytes()),
    ]


# -- ways to break a file ------------------------------------------------------------------------

Random = np.random.Generator
ODD = [b"1e400", b"1e-310", b"nan", b"-inf", b'"', b"'", b",", b";", b"\t", b"|", b"\x00", b"0x1F",
       b"1_000", b"\xff", b"\xc3", b"\xef\xbb\xbf", b"\r", b"\n\n", b"#", b"%", b"--5", b"1.2.3",
       b"12.03.2026", b"25:61:00", b"99999999999999999999", b"=1+1", "\u2028".encode(),
       "\uff11".encode(), b"1,234.5"]  # fmt: skip


def truncated(raw: bytes, r: Random) -> bytes:
    return raw[: int(r.integers(0, len(raw)))]


def flipped(raw: bytes, r: Random) -> bytes:
    made = bytearray(raw)
    for at in r.integers(0, len(raw), int(r.integers(1, 20))):
        made[at] ^= int(r.integers(1, 256))
    return bytes(made)


def flipped_at_the_front(raw: bytes, r: Random) -> bytes:
    made = bytearray(raw)
    for at in r.integers(0, min(len(raw), 200), int(r.integers(1, 6))):
        made[at] = int(r.choice([0, 1, 127, 128, 255]))
    return bytes(made)


def odd_put_in(raw: bytes, r: Random) -> bytes:
    for _ in range(int(r.integers(1, 5))):
        at = int(r.integers(0, len(raw) + 1))
        raw = raw[:at] + ODD[int(r.integers(len(ODD)))] + raw[at:]
    return raw


def ragged(raw: bytes, r: Random) -> bytes:
    lines = raw.split(b"\n")
    at = int(r.integers(len(lines)))
    lines[at] = lines[at][: int(r.integers(0, len(lines[at]) + 1))]
    return b"\n".join(lines)


def other_delimiter(raw: bytes, r: Random) -> bytes:
    old, new = r.choice([b",", b";", b"\t", b".", b" ", b"\n"], 2, replace=False)
    start = int(r.integers(0, len(raw) + 1)) if r.random() < 0.5 else 0
    return raw[:start] + raw[start:].replace(bytes(old), bytes(new))


def zeros(raw: bytes, r: Random) -> bytes:
    at = int(r.integers(0, len(raw) + 1))
    return raw[:at] + bytes(int(r.integers(1, 600))) + raw[at:]


def huge_cell(raw: bytes, r: Random) -> bytes:
    at = int(r.integers(0, len(raw) + 1))
    return raw[:at] + bytes([r.choice(list(b'9ax,"; '))]) * int(r.integers(1, 300_000)) + raw[at:]


def mixed_encodings(raw: bytes, r: Random) -> bytes:
    half = len(raw) // 2
    name = ["utf-16", "utf-16-le", "utf-8-sig", "cp1252", "utf-32"][int(r.integers(5))]
    part = raw[:half].decode("latin-1").replace("v", "µ°")
    return part.encode(name, "replace") + raw[half:]


def shuffled(raw: bytes, r: Random) -> bytes:
    a, b = sorted(int(k) for k in r.integers(0, len(raw) + 1, 2))
    return raw[b:] + raw[a:b] + raw[:a]


def repeated(raw: bytes, r: Random) -> bytes:
    return raw * int(r.integers(2, 5))


def nothing_but_rubbish(raw: bytes, r: Random) -> bytes:
    return raw[: int(r.integers(0, 12))] + r.bytes(int(r.integers(1, 4000)))


WAYS = [truncated, flipped, flipped_at_the_front, odd_put_in, ragged, other_delimiter, zeros,
        huge_cell, mixed_encodings, shuffled, repeated, nothing_but_rubbish]  # fmt: skip


def malformed(number: int, good: list[tuple[str, bytes]]) -> tuple[str, bytes]:
    """File number so-and-so: its ending, and what it holds; the same in every run."""
    r = np.random.default_rng([number, 20260312])
    ending, raw = good[number % len(good)]
    for _ in range(1 + int(r.random() < 0.3)):
        raw = WAYS[int(r.integers(len(WAYS)))](raw, r)
    if r.random() < 0.1:
        ending = good[int(r.integers(len(good)))][0]
    return ending, raw


def read(file: Path) -> str:
    """What became of a file: "read", or the kind of error. Nothing else may come out."""
    topic = f"{file}:V" if file.suffix == ".bin" else file
    outcomes = []
    for way in (
        lambda: read_table(topic),
        lambda: load_runs(topic, SIGNALS, columns={"v": "1,2,3"}, rate=100),
        lambda: load_runs(topic, SIGNALS, at_rest=True, columns={"v": "v"}),
    ):
        try:
            way()
            outcomes.append("read")
        except CasestError as error:
            said = str(error)
            assert said, file
            assert "\n" not in said, said
            assert len(said) < 2000, said[:2000]
            outcomes.append(type(error).__name__)
    return outcomes[0]


def try_all(numbers: range, good: list[tuple[str, bytes]], folder: Path) -> Counter[str]:
    found: Counter[str] = Counter()
    for number in numbers:
        ending, raw = malformed(number, good)
        file = folder / f"{number}{ending}"
        file.write_bytes(raw)
        try:
            found[read(file)] += 1
        except Exception as error:
            raise AssertionError(f"file {number} ({ending}): {type(error).__name__}") from error
        file.unlink()
    return found


def test_the_files_are_whole_before_they_are_broken(good, tmp_path):
    for k, (ending, raw) in enumerate(good):
        file = tmp_path / f"{k}{ending}"
        file.write_bytes(raw)
        table = read_table(f"{file}:V" if ending == ".bin" else file)
        assert table.n_rows == 40


@pytest.mark.parametrize(
    "numbers", [range(SOME), pytest.param(range(SOME, FILES), marks=pytest.mark.long)]
)
def test_malformed_files_end_in_a_sentence(good, tmp_path, numbers):
    found = try_all(numbers, good, tmp_path)
    assert found.total() == len(numbers)
    assert found["DataError"] > len(numbers) / 2  # the ways do break files
    assert found["read"] > len(numbers) / 20  # and not all of them

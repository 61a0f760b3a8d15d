"""From a calibration to C on a microcontroller: the function, compiled and run against casest."""

import shutil
import subprocess
from pathlib import Path

from casest.cli import run
from casest.demo import RECORD

read = [str(RECORD), "--columns", "v=ax,ay,az", "--rate", "50", "--at-rest"]
assert run(["calibrate", "norm-triangular", *read, "--set", "norm=9.80665 m/s^2", "-o", "out"]) == 0
assert run(["export", "out", "--to", "c", "--float", "-o", "correction.c"]) == 0

source = Path("correction.c").read_text(encoding="utf-8")
print(source[: source.index("#include")])
operations = source.count("  w[")
print(f"{operations} operations, {len(source.encode())} bytes of source, float, no heap")
if shutil.which("cc"):
    compiler = ["cc", "-std=c99", "-O2", "-DCASEST_SELF_TEST", "correction.c", "-lm", "-o", "test"]
    subprocess.run(compiler, check=True)
    print(subprocess.run(["./test"], check=True, capture_output=True, text=True).stdout)
assert operations < 100

"""The command to type next, made of the words that were typed: it can be pasted as it stands."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from casest.results.written import apart

WIDTH = 80

_OUTPUT = ("-o", "--output")
#: Options without a value.
_FLAGS = (
    "--at-rest", "--json", "--force", "--float", "--with-std", "--validate", "--profile",
    "--partitions", "--covariance", "--separate", "--help", "--version",
)  # fmt: skip
_READING = ("--columns", "--unit", "--scale", "--rate", "--time-zero")
_MODEL = ("--set", "--free", "--fix", "--shared", "--per-run", "--effects", "--at-rest", "--prior")
_FIT = ("--start", "--solver", "--seed", "--holdout", "--sensor-noise", "--noise-law")


@dataclass(frozen=True)
class Typed:
    """A command line: the command, its arguments, its options with their values."""

    name: str
    arguments: tuple[str, ...]
    options: tuple[tuple[str, str | None], ...]

    def keeping(self, name: str, flags: Sequence[str], *arguments: str) -> Typed:
        """Another command with the same options, as far as it has them."""
        kept = tuple((flag, value) for flag, value in self.options if flag in flags)
        return Typed(name, arguments or self.arguments, kept)

    def into(self, output: str | Path) -> Typed:
        """The same command with results written to `output`, or beside it if that is read."""
        kept = tuple(pair for pair in self.options if pair[0] not in _OUTPUT)
        return replace(self, options=(*kept, ("-o", str(apart(self.name, output, self.read)))))

    @property
    def read(self) -> tuple[str, ...]:
        """Arguments and values of options that may name a file to be read."""
        values = (value for flag, value in self.options if value and flag not in _OUTPUT)
        return (*self.arguments, *values)

    @property
    def output(self) -> str | None:
        """Where results are written; None where nothing says it."""
        return next((v for flag, v in reversed(self.options) if flag in _OUTPUT), None)

    def lines(self) -> str:
        """The command, indented; a long one continues on the next line as a shell reads it."""
        words = ["casest", self.name, *map(shlex.quote, self.arguments)]
        for flag, value in self.options:
            words.append(flag if value is None else f"{flag} {shlex.quote(value)}")
        lines = [" "]
        for word in words:
            if len(lines[-1]) + len(word) > WIDTH - 3 and lines[-1].strip():
                lines[-1] += " \\"
                lines.append("     ")
            lines[-1] += f" {word}"
        return "\n".join(lines)


def typed_words(command: str) -> Typed | None:
    """Read a command line as it was typed; None where it is none of casest's."""
    words = shlex.split(command)
    if len(words) < 2 or words[0] != "casest":
        return None
    arguments: list[str] = []
    options: list[tuple[str, str | None]] = []
    rest = iter(words[2:])
    for word in rest:
        if word.startswith("--") and "=" in word:
            flag, _, value = word.partition("=")
            options.append((flag, value))
        elif word in _FLAGS:
            options.append((word, None))
        elif word.startswith("-o") and len(word) > 2:
            options.append(("-o", word[2:]))
        elif word.startswith("-") and len(word) > 1:
            options.append((word, next(rest, "")))
        else:
            arguments.append(word)
    return Typed(words[1], tuple(arguments), tuple(options))


def recalibrating(command: str, fitted: str, data: str, held: Mapping[str, str]) -> str:
    """The calibration of another file in one line: read as in `command`, the model as in `fitted`,
    with parameters `held` at a value; empty where the model is not that of a `calibrate`."""
    typed, made = typed_words(command), typed_words(fitted)
    if typed is None or made is None or made.name != "calibrate" or not made.arguments:
        return ""
    kept = [pair for pair in made.options if pair[0] in _MODEL and pair[0] != "--at-rest"]
    read = [pair for pair in typed.options if pair[0] in (*_READING, "--at-rest")]
    held_now = [("--fix", f"{name}={value}") for name, value in held.items()]
    now, before = ([o for o in t.options if o[0] == "--sensor-noise"] for t in (typed, made))
    words = ["casest", "calibrate", made.arguments[0], data]
    for flag, value in (*kept, *read, *held_now, *(now or before)):
        words += [flag] if value is None else [flag, value]
    return shlex.join(words)


def following(
    command: str,
    output: str | Path | None = None,
    *,
    trusted: bool = True,
    doubtful: bool = False,
    likely: str = "",
    applies: bool = True,
    moving: bool = False,
    file: str | Path = "",
    fitted: str = "",
) -> str:
    """What to type after `command`, a line of words and the command each; empty where unknown.

    output: folder of its results; trusted: whether there is an estimate to go on with; doubtful:
    whether its residual speaks against the model; likely: a cause that may be there; applies:
    whether the model says what readings correct to, or that an estimator in motion lacks nothing;
    moving: whether it is one; file: what simulate, apply or export has written; fitted: the command
    that made the result.
    """
    typed = typed_words(command)
    if typed is None or not typed.arguments:
        return ""
    if typed.name == "close" and moving:
        steps = _after_motion(typed, output, trusted and applies)
    elif typed.name in ("calibrate", "close"):
        unexplained = doubtful and typed.name == "close"
        applies = applies and not doubtful
        steps = _after_fit(typed, output, trusted, applies, unexplained, likely)
    elif typed.name == "simulate":
        steps = (_after_flight if moving else _after_simulate)(typed, file)
    elif typed.name == "export":
        steps = _device(typed, file, fitted)
    elif typed.name == "apply":
        steps = _after_apply(typed, file)
    else:
        steps = _after_look(typed, output, trusted, applies)
    return "\n".join(f"Next: {words}\n{step}" for words, step in steps)


def applying(typed: Typed, output: str | Path) -> Typed:
    """`casest apply` on the first of the fitted files, with the words that read it."""
    data = typed.arguments[1] if len(typed.arguments) > 1 else "DATA"
    return typed.keeping("apply", _READING, str(output), data).into(Path(output) / "corrected.csv")


_Steps = Iterator[tuple[str, str]]


def _after_fit(
    typed: Typed,
    output: str | Path | None,
    trusted: bool,
    applies: bool,
    unexplained: bool,
    likely: str,
) -> _Steps:
    flags = (*_MODEL, *_READING, *_FIT)
    if not trusted:
        yield "what can these data see?", typed.keeping("observe", (*_MODEL, *_READING)).lines()
        return
    if typed.name == "calibrate":
        into = Path(output) / "closed" if output else "out"
        own = [flag for flag in flags if flag != "--noise-law"]  # that is calibrate's
        yield "does the model lack an effect?", typed.keeping("close", own).into(into).lines()
    if unexplained:
        words = "if you know of an effect, written as docs/add_effect.md says in my_effect.py"
        words = f"if you know that it is {likely}" if likely else words
        named = typed.keeping("close", flags)
        named = replace(named, options=(*named.options, ("--effects", likely or "my_effect.py")))
        yield words, named.into(Path(output) / "asked" if output else "out").lines()
    if output is None:
        yield "keep the result", typed.keeping(typed.name, flags).into("out").lines()
    elif applies:
        yield "correct readings", applying(typed, output).lines()
        yield "the correction for a device", exporting(output).lines()


def exporting(result: str | Path) -> Typed:
    """`casest export` of a result, in its folder."""
    folder = Path(result).parent if Path(result).suffix == ".json" else Path(result)
    return Typed("export", (str(result),), (("--to", "c"),)).into(folder / "correction.c")


def _after_motion(typed: Typed, output: str | Path | None, complete: bool) -> _Steps:
    """After the loop of an estimator in motion: there is nothing to apply, but states."""
    reading, noise = (*_READING, "--set"), "--sensor-noise"
    if output is None:
        yield "keep the result", typed.keeping("close", (*reading, noise)).into("out").lines()
        return
    if complete:  # a filter whose model lacks something has no states to keep
        states = typed.keeping("filter", reading)
        states = replace(states, options=(*states.options, ("--noise", "ml")))
        into = Path(output) / "states"
        yield "the states, noise matched to the record", states.into(into).lines()
    seen = typed.keeping("observe", (*reading, noise)).into(Path(output) / "seen")
    yield "what can this trajectory see?", seen.lines()


def _after_look(typed: Typed, output: str | Path | None, trusted: bool, applies: bool) -> _Steps:
    """After observe, filter and compare; only estimators in motion have nothing to apply."""
    from casest.data.logs import parts_of  # imported late: it brings NumPy, which --help is without

    reading = (*_READING, "--set", "--sensor-noise")
    motion = (*reading, "--std", "--intensity")
    if typed.name == "filter":
        if output is None:
            noise = ("--noise", "--rest")
            yield "keep the states", typed.keeping("filter", (*motion, *noise)).into("out").lines()
        yield "what can this trajectory see?", typed.keeping("observe", motion).lines()
        if len(parts_of(typed.arguments[-1])) == 1:  # the loop wants one clock
            yield "is something missing?", typed.keeping("close", reading).into("out").lines()
    elif len(typed.arguments) < 2:
        return
    elif not applies:
        yield "estimate the states", typed.keeping("filter", motion).into("out").lines()
    elif trusted:
        fit = typed.keeping("calibrate", (*_MODEL, *_READING)).into("out")
        yield "estimate the parameters", fit.lines()


def _after_simulate(typed: Typed, file: str | Path) -> _Steps:
    model = tuple(flag for flag in _MODEL if flag != "--at-rest")
    fit = typed.keeping("calibrate", model, typed.arguments[0], str(file))
    folder = Path(file).parent
    yield "what does the record give back?", fit.into(folder / "fit").lines()
    if any(flag == "--effect" for flag, _ in typed.options):
        closed = replace(fit, name="close").into(folder / "closed")
        yield "is the effect found?", closed.lines()


def _after_flight(typed: Typed, file: str | Path) -> _Steps:
    """After a record of an estimator in motion was simulated."""
    folder, model = Path(file).parent, typed.arguments[0]
    noise = ("--set", "--std", "--intensity", "--sensor-noise")
    followed = typed.keeping("filter", noise, model, str(file)).into(folder / "states")
    yield "how well are the states found?", followed.lines()
    stated = ("--set", "--sensor-noise")
    closed = typed.keeping("close", stated, model, str(file)).into(folder / "closed")
    yield "is something missing?", closed.lines()


def _after_apply(typed: Typed, file: str | Path) -> _Steps:
    """After readings were corrected by a result, or by an exported correction."""
    result = Path(typed.arguments[0])
    if result.suffix != ".json" or result.name == "result.json":
        yield "the correction for a device", exporting(result).lines()
    else:
        name = shlex.quote(str(result))
        yield "correct another record", f"  casest apply {name} DATA -o FILE.csv"


def _device(typed: Typed, file: str | Path, fitted: str) -> _Steps:
    """After an export: its own check, or a record corrected by it alone."""
    to, name = dict(typed.options).get("--to"), shlex.quote(str(file))
    if to == "c":
        compiled = f"  cc -DCASEST_SELF_TEST {name} -lm -o self-test && ./self-test"
        yield "compile it and run its self-test", compiled
    elif to == "python":
        yield "run its self-test", f"  python {name}"
    elif to == "json":
        words = applying(typed_words(fitted) or Typed("", (), ()), file)
        into = Path(file).with_name(f"{Path(file).stem}-applied.csv")
        yield "correct readings", words.into(into).lines()

"""`name=value` behind an option, as it was typed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from casest.errors import UnitError, UsageError

if TYPE_CHECKING:
    from casest.declaration.model import Model


@dataclass(frozen=True, slots=True)
class Assignment:
    """`flag name=value`; what the value means is asked where the model is known.

    Whatever is wrong with it is a UsageError that shows the option as it was typed.
    """

    flag: str
    text: str

    def pair(self) -> tuple[str, str]:
        """Name and value, neither of them empty."""
        key, equals, value = self.text.partition("=")
        if not equals or not key or not value:
            raise self._malformed()
        return key, value

    def number(
        self, units: Mapping[str, str] | None = None, *, spread: bool = False
    ) -> tuple[str, float]:
        """`name=number`, or `name=number unit` in the unit that the name has in `units`.

        `spread`: a standard deviation, of which 1 degC is 1 K.
        """
        key, value = self.pair()
        own = (units or {}).get(key)
        try:
            return key, float(value)
        except ValueError:
            if own is None:
                raise UsageError(f"{self.flag} {self.text}: {value!r} is no number") from None
        number, zero = self._in_unit(value, own)
        return key, number if spread else number + zero

    def _in_unit(self, text: str, own: str) -> tuple[float, float]:
        from casest.units import conversion, parse_quantity

        try:
            number, unit = parse_quantity(text)
            factor, offset = conversion(unit or own, own)
            return factor * number, offset
        except UnitError as error:
            raise UsageError(f"{self.flag} {self.text}: {error}") from None
        except UsageError:
            raise UsageError(
                f"{self.flag} {self.text}: {text!r} is no number; write it as 0.2 ({own}) or with "
                "its unit"
            ) from None

    def numbers(self) -> tuple[str, list[float]]:
        """`name=1,2,3`."""
        key, value = self.pair()
        try:
            return key, [float(part) for part in value.split(",")]
        except ValueError:
            raise UsageError(f"{self.flag} {self.text}: {value!r} are no numbers") from None

    def of(self, model: Model) -> tuple[str, Any]:
        """A name of the model and its value: a constant with unit."""
        from casest.cli.values import parse_value

        key, equals, value = self.text.partition("=")
        if not equals or not value:
            raise self._malformed()  # a name that is missing is the model's to refuse
        return key, parse_value(key, value, self.flag, model)

    def start(self, model: Model) -> tuple[str, Any]:
        """An unknown of the model and its start value in the unknown's own unit."""
        from casest.declaration.symbols import Parameter

        key, value = self.of(model)
        if not isinstance(model[key], Parameter):
            raise UsageError(f"{self.flag} {self.text}: {key} is no unknown of {model.name}")
        return key, model.having(**{key: value})[key].array

    def _malformed(self) -> UsageError:
        return UsageError(f"{self.flag} {self.text}: write it as {self.flag} name=value")


#: What an option that is given several times holds.
Assignments = tuple[Assignment, ...]

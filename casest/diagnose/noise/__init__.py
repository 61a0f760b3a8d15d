"""The noise as it is: size, colour, tails, lines. Imports levels."""

"""What any record could show: structural observability and identifiability.

The readings and their derivatives along the motion, y, ẏ, ÿ, …, are functions of the state; where
their Jacobian has full rank at almost every point, the state is (locally) observable from suitable
data (Hermann & Krener 1977). Parameters are states without a rate, so that the same rank says
whether they are identifiable. Inputs are functions of time with derivatives of any size, or held
constant, which may show less (Villaverde et al. 2019).
"""

from __future__ import annotations

from casest.dynamics.structural.answer import Structure, structure

__all__ = ["Structure", "structure"]

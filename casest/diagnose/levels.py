"""Numbers that several rooms of the loop share."""

from __future__ import annotations

#: Share of a candidate's own length that must survive the projection: below, it is invisible.
SURVIVES = 1e-6
#: Samples whose slopes are held at once.
PIECE = 8192
#: A residual counts as at most this many robust standard deviations: a few bad samples ask for
#: nothing.
CLIPPED = 3.5


#: Log-likelihood by which a shape must beat a random walk.
BEYOND_WALK = 5.0


#: Stretches that a continuous record is cut into.
STRETCHES = 40

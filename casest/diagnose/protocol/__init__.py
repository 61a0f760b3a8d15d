"""The loop, for residuals and for innovations: rank, refit, confirm, eliminate.

A `Subject` knows its model: what could be missing there, in which columns it shows, how to refit.
The loop knows nothing of models: it asks which cause explains most, whether what was held out
confirms it, and what cannot be told apart. A state of the search is a value: what is tried and
dropped leaves no trace. Imports evidence, levels.
"""

from casest.diagnose.protocol.confirming import falls, holds_out
from casest.diagnose.protocol.ranking import pairs, ranked, ranked_of
from casest.diagnose.protocol.rivals import with_rivals
from casest.diagnose.protocol.rounds import search
from casest.diagnose.protocol.state import Kept, Ranking, Rival, State
from casest.diagnose.protocol.subject import Subject

__all__ = [
    "Kept", "Ranking", "Rival", "State", "Subject", "falls", "holds_out", "pairs", "ranked",
    "ranked_of", "search", "with_rivals",
]  # fmt: skip

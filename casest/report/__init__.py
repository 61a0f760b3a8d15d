"""`report.html`: what was found, why it is believed, how it is used, on one self-contained page."""

from casest.report.calibration import calibration_page
from casest.report.closed import closing_page
from casest.report.motion import filter_page, observe_page
from casest.report.motion_closed import closing_motion_page

REPORT = "report.html"

__all__ = [
    "REPORT",
    "calibration_page",
    "closing_motion_page",
    "closing_page",
    "filter_page",
    "observe_page",
]

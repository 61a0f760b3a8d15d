"""`report.html`: what was found, why it is believed, how it is used, on one self-contained page."""

from casest.report.html.calibration import calibration_page
from casest.report.html.check import check_page
from casest.report.html.closed import closing_page
from casest.report.html.motion import filter_page, observe_page
from casest.report.html.motion_closed import closing_motion_page
from casest.report.html.plan import plan_page
from casest.report.html.side_by_side import side_by_side_page

REPORT = "report.html"

__all__ = [
    "REPORT",
    "calibration_page",
    "check_page",
    "closing_motion_page",
    "closing_page",
    "filter_page",
    "observe_page",
    "plan_page",
    "side_by_side_page",
]

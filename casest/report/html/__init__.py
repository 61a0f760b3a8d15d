"""`report.html`: what was found, why it is believed, how it is used, on one self-contained page.

Each kind of page is a module: a command loads its own, not what the others need.
"""

REPORT = "report.html"

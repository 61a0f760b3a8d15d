"""Logs of several topics, each with its own times: ROS bags, PX4 and ArduPilot logs."""

from casest.data.logs.naming import file_and_topics, file_name, is_log, parts_of
from casest.data.logs.reading import read_log

__all__ = ["file_and_topics", "file_name", "is_log", "parts_of", "read_log"]

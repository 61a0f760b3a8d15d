"""Logs of several topics, each with its own times: ROS bags, PX4 and ArduPilot logs."""

from casest.data.logs.naming import file_and_topics, file_name, is_log
from casest.data.logs.reading import read_log

__all__ = ["file_and_topics", "file_name", "is_log", "read_log"]

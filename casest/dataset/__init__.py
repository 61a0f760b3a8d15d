"""Parquet data sets of many sensors: files, layout, partitions, readings."""

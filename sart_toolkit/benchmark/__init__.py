"""Measurements of the toolkit itself, over tasks and backends."""

"""Demonstrations: the recording session, what steers it, and its window."""

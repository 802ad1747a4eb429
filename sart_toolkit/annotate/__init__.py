"""Precision spheres: suggested from the scene, and set by a person."""

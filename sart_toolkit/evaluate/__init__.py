"""Rollouts of a skill, their statistics and videos, and the report of a run."""

"""Teach a robot a skill from one demonstration (SART)."""


"""Reflection probes: which serve a picture, how they are captured and filtered, where they reach, what they
answer.
"""

__all__ = ["capture", "digest", "lookup", "plan", "reach", "volumes"]

"""A frame: the scene made ready, tiles on threads, progress and cancel."""

__all__ = ["picture", "ready", "session", "unfinished", "work"]
